//! Kills a random process every second or so, and scales the actors up and down, with a fixed seed. At the end the
//! replay holds everything that was sent exactly once, and the run can continue and learn its task.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use rand::{RngExt, SeedableRng};
use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use shoal_common::config::Config;
use shoal_common::stream::Stream;
use support::{Running, Workplace, check_stored_rows, committed, parse, sent};

const MAX_ACTORS: u32 = 4;

/// A process that was killed.
struct Kill {
    who: String,
    pid: i64,
    at: f64,
}

/// The results of one chaos run.
struct ChaosResults {
    kills: usize,
    /// Seconds from each kill until the successor was ready, ascending.
    recoveries: Vec<f64>,
    rows: u64,
    rows_lost: u64,
    scalings: usize,
    /// The longest time between two reports of the learner, in seconds. It reports twice a second.
    silence: f64,
}

fn now() -> f64 {
    SystemTime::UNIX_EPOCH.elapsed().unwrap().as_secs_f64()
}

/// Kills and scales for `length`. Returns the kills and the number of scalings.
fn kill_and_scale(place: &Workplace, running: &Running, rng: &mut Stream, length: Duration) -> (Vec<Kill>, usize) {
    let (begun, mut kills, mut scalings) = (Instant::now(), Vec::new(), 0);
    while begun.elapsed() < length {
        // A random pause, so that a kill may come at any moment.
        std::thread::sleep(Duration::from_millis(rng.random_range(300..1500)));
        if rng.random_bool(0.2) {
            let actors = rng.random_range(1..=MAX_ACTORS).to_string();
            let output = place.output(&["scale", "run", "--actors", &actors]);
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            scalings += 1;
            continue;
        }
        let status = place.status("run");
        let roles = status["roles"].as_array().unwrap();
        let victim = &roles[rng.random_range(0..roles.len())];
        let who = format!("{}-{}", victim["role"].as_str().unwrap(), victim["index"]);
        let Some(pid) = victim["pid"].as_i64() else { continue };
        // The process may have ended or been replaced since the status was read.
        if running.pids(&who).last().is_some_and(|last| i64::from(*last) == pid)
            && kill_process(Pid::from_raw(pid as i32).unwrap(), Signal::KILL).is_ok()
        {
            kills.push(Kill { who, pid, at: now() });
        }
    }
    (kills, scalings)
}

/// The seconds since 1970 of a time in the log, such as `2026-11-28T04:12:57.123456Z`.
fn seconds(time: &str) -> Option<f64> {
    let (date, time) = time.strip_suffix('Z')?.split_once('T')?;
    let numbers = |text: &str, sign| {
        text.split(sign)
            .map(|part| part.parse::<f64>().ok())
            .collect::<Option<Vec<_>>>()
    };
    let (date, time) = (numbers(date, '-')?, numbers(time, ':')?);
    let (&[year, month, day], &[hours, minutes, seconds]) = (&date[..], &time[..]) else {
        return None;
    };
    // The year begins in March here, so that the leap day is its last.
    let (year, month) = if month > 2.0 {
        (year, month - 3.0)
    } else {
        (year - 1.0, month + 9.0)
    };
    let leap_days = (year / 4.0).floor() - (year / 100.0).floor() + (year / 400.0).floor();
    let days = 365.0 * year + leap_days + ((153.0 * month + 2.0) / 5.0).floor() + day - 1.0 - 719_468.0;
    Some(((days * 24.0 + hours) * 60.0 + minutes) * 60.0 + seconds)
}

#[test]
fn times_in_the_log_are_read() {
    assert_eq!(seconds("1970-01-01T00:00:00.000000Z"), Some(0.0));
    assert_eq!(seconds("2024-02-29T12:00:01.500000Z"), Some(1_709_208_001.5));
    assert_eq!(seconds("ready"), None);
}

/// The launcher's log lines about a role, with their times.
fn notes(log: &str, who: &str) -> Vec<(f64, String)> {
    let of = |line: &str| {
        let (name, rest) = line.split_once(' ')?;
        let (time, message) = rest.trim_start().split_once(' ')?;
        Some((seconds(time)?, message.to_owned())).filter(|_| name == who)
    };
    log.lines().filter_map(of).collect()
}

/// When the successor of the killed process was ready. `None` if there was none, because the process was retiring or no
/// longer needed.
fn ready_again(log: &str, kill: &Kill) -> Option<f64> {
    let notes = notes(log, &kill.who);
    let started = format!("started as process {}", kill.pid);
    let killed = notes.iter().position(|(_, message)| *message == started)?;
    let ended = notes
        .iter()
        .skip(killed)
        .position(|(_, message)| message.contains("killed by signal 9"))?;
    let after = &notes[killed + ended..];
    let ready = after
        .iter()
        .position(|(_, message)| message.starts_with("ready after"))?;
    let was_needed = !after[..ready]
        .iter()
        .any(|(_, message)| message.contains("no longer needed"));
    was_needed.then_some(after[ready].0)
}

/// Whether no learner was ready at some moment within half a second of `time`.
fn learner_was_away(log: &str, kills: &[Kill], time: f64) -> bool {
    kills.iter().filter(|kill| kill.who == "learner-0").any(|kill| {
        let back = ready_again(log, kill).unwrap_or(f64::INFINITY);
        time > kill.at - 0.5 && time < back + 0.5
    })
}

/// Checks that everything that was sent is in the replay, except what may be lost. Returns the rows in the replay and
/// the rows lost.
fn check_sent_rows(run: &Path, config: &Config, kills: &[Kill]) -> (u64, u64) {
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    let chunk = config.chunk_rows() as u64;
    let (mut rows, mut lost) = (0, 0);
    for actor in 0..MAX_ACTORS {
        let (sent, committed) = (sent(run, actor), committed(run, actor as usize));
        let own = kills.iter().filter(|kill| kill.who == format!("actor-{actor}"));
        let (alone, with_learner): (Vec<_>, Vec<_>) = own.partition(|kill| !learner_was_away(&log, kills, kill.at));
        // An actor may be killed after it has sent a chunk and before it has logged that.
        let unlogged = chunk * (alone.len() + with_learner.len()) as u64;
        let windows = chunk * u64::from(config.actors.window) * with_learner.len() as u64;
        assert!(
            (sent.saturating_sub(windows)..=sent + unlogged).contains(&committed),
            "actor {actor} sent {sent} rows, {committed} are in the replay; killed {} times with a learner, {} without",
            alone.len(),
            with_learner.len()
        );
        rows += committed;
        lost += sent.saturating_sub(committed);
    }
    (rows, lost)
}

/// Checks that the learner is never ahead of the ratio, and takes nothing in while the actors are ahead by more than
/// the tolerance. Returns the longest time between two reports, in seconds.
fn ratio_is_kept(run: &Path, config: &Config) -> f64 {
    #[derive(serde::Deserialize)]
    struct Row {
        wall_seconds: f64,
        env_steps: u64,
        updates: u64,
    }
    let rows: Vec<Row> = csv::Reader::from_path(run.join("learner.csv"))
        .unwrap()
        .into_deserialize()
        .collect::<Result<_, _>>()
        .unwrap();
    assert!(rows.len() > 10);
    let beyond = |row: &Row| row.env_steps.saturating_sub(config.replay.warmup);
    let mut seen = 0;
    // The last report includes what was taken in when the run was stopped.
    for two in rows[..rows.len() - 1].windows(2) {
        assert!(two[1].updates <= beyond(&two[1]), "ahead of the ratio");
        // A learner reports every half second. A longer gap means a new one, which has gradient steps to repeat.
        let same_learner = two[1].wall_seconds - two[0].wall_seconds < 0.58;
        let took_in = same_learner && two[1].env_steps > two[0].env_steps;
        seen += usize::from(took_in);
        let tolerance = config.replay.tolerance + config.chunk_rows() as u64;
        assert!(
            !took_in || beyond(&two[1]) <= two[1].updates + tolerance,
            "{} steps were taken in with {} updates done",
            two[1].env_steps,
            two[1].updates
        );
    }
    // How many there are depends on the machine.
    assert!(seen > 0);
    let silences = rows.windows(2).map(|two| two[1].wall_seconds - two[0].wall_seconds);
    silences.fold(0.0, f64::max)
}

/// Kills and scales for `length` in a run started with `arguments`, stops it, and resumes it to at least `steps`.
/// Returns the results and what the resumed run printed.
fn chaos(seed: u64, length: Duration, arguments: &[&str], steps: u64) -> (ChaosResults, Value) {
    let place = Workplace::logging_chunks();
    let begin = ["train", "pendulum", "--run", "run", "--steps", "100000000"];
    let running = place.launch("run", &[&begin[..], arguments].concat());
    let run = running.run.clone();
    let mut rng = Stream::seed_from_u64(seed);
    let (kills, scalings) = kill_and_scale(&place, &running, &mut rng, length);

    let stopped = place.output(&["stop", "run"]);
    assert!(stopped.status.success(), "{}", String::from_utf8_lossy(&stopped.stderr));
    let (code, _, leftovers) = running.wait();
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    assert_eq!(code, Some(0), "{}\n{log}", place.stderr());
    assert!(leftovers.processes().is_empty(), "{:?}", leftovers.processes());
    assert!(leftovers.files().is_empty(), "{:?}", leftovers.files());
    let config = Config::load(&run.join("config.toml")).unwrap();
    let (rows, rows_lost) = check_sent_rows(&run, &config, &kills);
    assert_eq!(check_stored_rows(&run, &config), rows, "rows of all actors");
    let silence = ratio_is_kept(&run, &config);

    let steps = steps.max(rows + 1000).to_string();
    let (code, printed, leftovers) = place.resume("run", &["--steps", &steps]).wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let mut recoveries: Vec<_> = kills
        .iter()
        .filter_map(|kill| Some(ready_again(&log, kill)? - kill.at))
        .collect();
    recoveries.sort_by(f64::total_cmp);
    let results = ChaosResults {
        kills: kills.len(),
        recoveries,
        rows,
        rows_lost,
        scalings,
        silence,
    };
    (results, parse(&printed))
}

impl std::fmt::Display for ChaosResults {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let n = self.recoveries.len();
        let at = |share: f64| {
            self.recoveries
                .get(((n.max(1) - 1) as f64 * share).round() as usize)
                .copied()
                .unwrap_or(f64::NAN)
        };
        write!(
            f,
            "{} kills, {} scalings, {n} recoveries (seconds: median {:.3}, p99 {:.3}, longest {:.3}), {} rows, \
             {} of them lost; longest silence of the learner {:.3} s",
            self.kills,
            self.scalings,
            at(0.5),
            at(0.99),
            at(1.0),
            self.rows,
            self.rows_lost,
            self.silence
        )
    }
}

#[test]
fn every_sent_row_is_in_the_replay_once_after_random_kills() {
    let arguments = [&support::QUICK[..], &["--set", "replay.capacity=200000"]].concat();
    let (results, result) = chaos(20, Duration::from_secs(20), &arguments, 0);
    eprintln!("{results}");
    assert!(results.kills >= 5 && results.scalings >= 1 && results.recoveries.len() >= 4);
    assert_eq!(result["updates"], result["env_steps"].as_u64().unwrap() - 64);
}

#[test]
#[ignore = "takes minutes"]
fn the_pendulum_still_swings_up_after_a_minute_of_random_kills() {
    let (results, result) = chaos(60, Duration::from_secs(60), &[], 30_000);
    eprintln!("{results}; the best policy: {}", result["eval_return_mean"]);
    assert!(results.kills >= 20 && results.scalings >= 3);
    assert!(result["eval_return_mean"].as_f64().unwrap() > -250.0, "{result}");
}
