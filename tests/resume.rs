//! Interrupted runs can be resumed: after the launcher or every process was killed, and after files were damaged.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::collections::BTreeSet;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use shoal_common::channel::Domain;
use shoal_common::commit::CommitReader;
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use support::{Running, Workplace, contents, error_line, parse, until};

/// Rows in the ring of a quick run's replay.
const RING: u64 = 2000;

const ENDLESS: [&str; 2] = ["--steps", "100000000"];

/// Waits until the run has two checkpoints and a best policy.
fn wait_for_checkpoints(running: &Running) {
    let there = |name: &str| running.run.join("checkpoints").join(name).exists();
    // A learner killed while it saves may leave only the previous checkpoint.
    until("there are two checkpoints", || {
        there("previous.ckpt") && there("latest.ckpt")
    });
    until("there is a best policy", || there("best.policy"));
}

fn rows(run: &Path) -> u64 {
    CommitReader::open(&run.join("replay.bin")).unwrap().rows()
}

/// Starts a run, lets it learn, and kills all its processes. Returns its directory.
fn killed(place: &Workplace, arguments: &[&str]) -> std::path::PathBuf {
    let quickly = ["--set", "checkpoint.every_seconds=0.5"];
    let running = place.start("run", &[&ENDLESS[..], &quickly, arguments].concat());
    running.wait_for_learning();
    wait_for_checkpoints(&running);
    running.kill_all();
    running.run.clone()
}

/// Resumes the run for `more` steps, to its end. Returns its result.
fn resume_to_the_end(place: &Workplace, more: u64) -> serde_json::Value {
    let steps = rows(&place.path().join("run")) + more;
    let (code, printed, leftovers) = place.resume("run", &["--steps", &steps.to_string()]).wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let result = parse(&printed);
    assert_eq!(result["env_steps"], steps);
    assert_eq!(result["updates"], steps - 64);
    result
}

#[test]
fn a_run_whose_launcher_was_killed_can_be_resumed_at_once() {
    let place = Workplace::logging_chunks();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    let (run, before) = (running.run.clone(), rows(&running.run));
    running.signal(Signal::KILL);
    // The old roles may still be saving what they have.
    let resumed = place.resume("run", &[]);
    resumed.wait_for_learning();
    assert!(rows(&run) > before);
    assert!(place.output(&["stop", "run"]).status.success());
    let (code, _, leftovers) = resumed.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    for actor in 0..2 {
        let (sent, committed) = (support::sent(&run, actor), support::committed(&run, actor as usize));
        // Between two launchers an actor's last chunks, a few tenths of a second, are not logged.
        assert!(
            (sent..sent + 2000).contains(&committed),
            "actor {actor} sent {sent}, {committed} are there"
        );
    }
}

#[test]
fn resume_changes_nothing_before_the_last_role_of_a_killed_launcher_has_ended() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    let run = running.run.clone();
    wait_for_checkpoints(&running);
    // This process stands for a role that does not end. A stopped one would not do: the system continues it when its
    // launcher dies.
    let config = Config::load(&run.join("config.toml")).unwrap();
    let role = Domain::join(&config.run.id, config.actors.max_on_a_host()).unwrap();
    running.kill_all();

    let steps = (rows(&run) + 500).to_string();
    let change = ["--steps", &steps, "--set", "evaluation.episodes=3"];
    let before = contents(&run);
    let message = error_line(&place.output(&[&["resume", "run"], &change[..]].concat()));
    let advice = format!("still alive and do not end (stopped?): kill -9 {}", std::process::id());
    assert!(message.contains(&advice), "{message}");
    let after = contents(&run);
    let changed = before.iter().chain(&after).map(|(path, _)| path);
    let changed: BTreeSet<&PathBuf> = changed.filter(|path| before.get(*path) != after.get(*path)).collect();
    // It says why the run was not started.
    assert_eq!(changed, BTreeSet::from([&run.join("outcome.json")]));

    role.leave().unwrap();
    let (code, _, leftovers) = place.resume("run", &change).wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
}

#[test]
fn a_run_is_not_removed_before_the_last_role_of_its_killed_launcher_has_ended() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    let run = running.run.clone();
    wait_for_checkpoints(&running);
    // This process stands for a role that does not end, as in the test above.
    let config = Config::load(&run.join("config.toml")).unwrap();
    let role = Domain::join(&config.run.id, config.actors.max_on_a_host()).unwrap();
    running.kill_all();
    let before = contents(&run);
    let message = error_line(&place.output(&["rm", "--yes", "run"]));
    let advice = format!("still alive and do not end (stopped?): kill -9 {}", std::process::id());
    assert!(
        message.contains("cannot remove ") && message.contains(&advice),
        "{message}"
    );
    assert_eq!(contents(&run), before);
    role.leave().unwrap();
    assert!(place.output(&["rm", "--yes", "run"]).status.success());
    assert!(!run.exists());
}

#[test]
fn nothing_is_written_into_a_run_that_takes_the_place_of_one_that_is_resumed() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "500", "--run", "run"]);
    place.copy("run", "other");
    let [run, other, kept] = ["run", "other", "kept"].map(|name| place.path().join(name));
    // So many episodes that the best policy is evaluated again for seconds.
    let longer = ["--steps", "600", "--set", "evaluation.episodes=10000"];
    let mut resumed = place.shoal(&[&["resume", "run"], &longer[..]].concat());
    let resumed = resumed.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    until("the run is locked", || {
        RunDir::open(&run).unwrap().is_running().unwrap()
    });
    let before = contents(&other);
    std::fs::rename(&run, &kept).unwrap();
    std::fs::rename(&other, &run).unwrap();
    let output = resumed.wait_with_output().unwrap();
    let said = error_line(&output);
    assert!(said.contains("removed or renamed"), "{said}");
    let after = contents(&run);
    assert!(
        before.len() == after.len() && before.values().eq(after.values()),
        "{:?}",
        after.keys()
    );
}

#[test]
fn no_committed_row_is_lost_when_all_processes_are_killed_at_once() {
    let place = Workplace::new();
    let run = killed(&place, &[]);
    let before = rows(&run);
    assert!(before > 64);
    let status = place.output(&["status", "run", "--json"]);
    assert_eq!(status.status.code(), Some(3));
    assert_eq!(support::json(&status)["replay_rows"], before);
    resume_to_the_end(&place, 2000);
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    assert!(
        log.contains(&format!("of {before} rows")),
        "the learner began with all of them: {log}"
    );
}

#[test]
fn a_period_that_was_evaluated_is_not_evaluated_again() {
    let place = Workplace::new();
    let running = place.start("run", &[&ENDLESS[..], &["--set", "evaluation.every=50000000"]].concat());
    let evaluations = running.run.join("evaluations.csv");
    let evaluated = || std::fs::read_to_string(&evaluations).unwrap().lines().count() - 1;
    until("the first policy is evaluated", || evaluated() == 1);
    running.kill("evaluator-0");
    until("it is replaced", || running.pids("evaluator-0").len() >= 2);
    running.wait_for_learning();
    assert!(place.output(&["stop", "run"]).status.success());
    running.wait();
    resume_to_the_end(&place, 2000);
    assert_eq!(evaluated(), 1);
}

#[test]
fn a_role_paused_for_a_while_continues_and_nothing_is_stored_twice() {
    pause_each_role(Duration::from_secs(4));
}

#[test]
#[ignore = "takes minutes"]
fn a_role_paused_for_half_a_minute_continues_and_nothing_is_stored_twice() {
    pause_each_role(Duration::from_secs(30));
}

/// Pauses each role in turn with SIGSTOP, then the launcher.
fn pause_each_role(length: Duration) {
    let place = Workplace::logging_chunks();
    let running = place.start("run", &[&ENDLESS[..], &["--set", "replay.capacity=200000"]].concat());
    let run = running.run.clone();
    running.wait_for_learning();
    for who in ["actor-0", "env-server-0", "evaluator-0", "env-server-16", "learner-0"] {
        running.stop_role(who);
        let begun = Instant::now();
        until("it is reported silent", || place.role("run", who)["state"] == "silent");
        // The length of the pause is what is tested.
        std::thread::sleep(length.saturating_sub(begun.elapsed()));
        running.continue_role(who);
        running.wait_for_learning();
    }
    running.signal(Signal::STOP);
    // The same for the launcher.
    std::thread::sleep(length);
    running.signal(Signal::CONT);
    running.wait_for_learning();
    assert_eq!(place.status("run")["running"], true);

    assert!(place.output(&["stop", "run"]).status.success());
    let log = running.log();
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.files().is_empty());
    assert!(!log.contains("restarting it"), "{log}");
    support::assert_all_rows_committed(&run, 2);
}

#[test]
fn a_damaged_checkpoint_is_reported_and_the_one_before_it_used() {
    let place = Workplace::new();
    let running = place.start(
        "run",
        &[&ENDLESS[..], &["--set", "checkpoint.every_seconds=0.5"]].concat(),
    );
    wait_for_checkpoints(&running);
    // Stopped, not killed, so that both checkpoints certainly exist.
    assert!(place.output(&["stop", "run"]).status.success());
    let run = running.run.clone();
    assert_eq!(running.wait().0, Some(0));
    let latest = run.join("checkpoints/latest.ckpt");
    let mut bytes = std::fs::read(&latest).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&latest, &bytes).unwrap();
    resume_to_the_end(&place, 500);
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    assert!(
        log.contains("latest.ckpt: is damaged") && log.contains("continuing from"),
        "{log}"
    );
    assert_eq!(
        std::fs::read(run.join("checkpoints/damaged-0.ckpt")).unwrap(),
        bytes,
        "kept for inspection"
    );
}

#[test]
fn a_run_with_a_lost_incarnation_counter_can_be_resumed() {
    for counter in [None, Some("3")] {
        let place = Workplace::new();
        let run = killed(&place, &[]);
        // Now the replay holds higher incarnations than a first start has.
        resume_to_the_end(&place, 500);
        let file = run.join("incarnations");
        match counter {
            None => std::fs::remove_file(&file).unwrap(),
            Some(number) => std::fs::write(&file, number).unwrap(),
        }
        resume_to_the_end(&place, 500);
    }
}

#[test]
fn resuming_a_copy_of_a_running_run_is_refused() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    place.copy("run", "copy");
    let message = error_line(&place.output(&["resume", "copy"]));
    assert!(
        message.contains("is a copy of") && message.contains(running.run.to_str().unwrap()),
        "{message}"
    );
    let outcome = std::fs::read_to_string(place.path().join("copy/outcome.json")).unwrap();
    let outcome: serde_json::Value = serde_json::from_str(&outcome).unwrap();
    assert_eq!(outcome["state"], "failed", "{outcome}");
    assert!(
        outcome["reason"].as_str().unwrap().contains("is a copy of"),
        "{outcome}"
    );
    running.wait_for_learning();
}

#[test]
fn files_that_do_not_belong_to_the_run_are_refused_and_left_unchanged() {
    let place = Workplace::new();
    let run = killed(&place, &[]);
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    let replay = std::fs::read(run.join("replay.bin")).unwrap();

    // Another configuration, and nothing that tells what the run was last used with.
    let used = run.join("config/used.toml");
    std::fs::remove_file(&used).unwrap();
    std::fs::write(run.join("config.toml"), config.replace("gamma = 0.99", "gamma = 0.9")).unwrap();
    let message = error_line(&place.output(&["resume", "run"]));
    assert!(message.contains("another configuration"), "{message}");
    std::fs::write(run.join("config.toml"), &config).unwrap();
    assert!(!used.exists(), "a run that is refused is left as it was");

    // A replay of another version: the second word of the file.
    let file = std::fs::File::options()
        .write(true)
        .open(run.join("replay.bin"))
        .unwrap();
    file.write_all_at(&99_u64.to_le_bytes(), 8).unwrap();
    let message = error_line(&place.output(&["resume", "run"]));
    assert!(
        message.contains("replay.bin") && message.contains("has format 99"),
        "{message}"
    );
    file.write_all_at(&replay[8..16], 8).unwrap();

    // Another layout.
    std::fs::write(
        run.join("config.toml"),
        config.replace("capacity = 2000", "capacity = 3000"),
    )
    .unwrap();
    let (code, message) = try_to_resume(&place);
    assert!(
        code == Some(1) && message.contains("its ring has 2000 rows, this run's 3000"),
        "{message}"
    );
    std::fs::write(run.join("config.toml"), &config).unwrap();
    std::fs::remove_file(&used).unwrap();

    assert_eq!(std::fs::read(run.join("replay.bin")).unwrap(), replay);
    resume_to_the_end(&place, 500);
}

/// Tries to resume the run. Returns the exit code and standard error.
fn try_to_resume(place: &Workplace) -> (Option<i32>, String) {
    let output = place.output(&["resume", "run", "--set", "run.give_up_seconds=1"]);
    (
        output.status.code(),
        String::from_utf8_lossy(&output.stderr).into_owned(),
    )
}

#[test]
fn after_a_power_loss_the_replay_falls_back_to_the_rows_that_reached_the_disk() {
    // Either the newest 20 rows or all rows in the ring never reached the disk.
    for lost in [20, RING] {
        let place = Workplace::new();
        let run = killed(&place, &[]);
        let before = rows(&run);
        let file = std::fs::File::options()
            .write(true)
            .open(run.join("replay.bin"))
            .unwrap();
        let row = 4 * Config::load(&run.join("config.toml")).unwrap().row_layout().width() as u64;
        let ring = file.metadata().unwrap().len() - (RING * row).next_multiple_of(4096);
        for index in before - lost.min(before)..before {
            file.write_all_at(&vec![0; row as usize], ring + index % RING * row)
                .unwrap();
        }
        drop(file);
        resume_to_the_end(&place, 3000);
        let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
        let whole = format!("of {before} rows");
        let fell_back = log.contains("did not reach the disk") && !log.contains(&whole);
        assert!(log.contains("WARN") && (fell_back || lost == RING), "{log}");
    }
}

#[test]
fn a_role_that_cannot_start_is_given_up_with_its_error_and_the_run_can_be_resumed() {
    let place = Workplace::new();
    let run = killed(&place, &[]);
    // A policy file that the evaluator cannot read.
    let best = run.join("checkpoints/best.policy");
    let bytes = std::fs::read(&best).unwrap();
    std::fs::write(&best, b"not a policy at all").unwrap();
    let (code, message) = try_to_resume(&place);
    assert_eq!(code, Some(1));
    assert!(
        message.contains("evaluator-0 failed")
            && message.contains("times and is given up")
            && message.contains("best.policy"),
        "{message}"
    );
    assert!(message.contains("shoal resume"), "{message}");
    std::fs::write(&best, bytes).unwrap();
    resume_to_the_end(&place, 500);
}

/// Networks and batches so large that gradient steps come long after their environment steps.
const SLOW_UPDATES: [&str; 14] = [
    "--steps",
    "1500",
    "--set",
    "replay.tolerance=1000000",
    "--set",
    "replay.warmup=64",
    "--set",
    "ddpg.hidden=[300, 300]",
    "--set",
    "ddpg.batch=256",
    "--set",
    "evaluation.every=1500",
    "--set",
    "evaluation.final_episodes=3",
];

#[test]
fn a_run_interrupted_after_its_last_environment_step_is_finished_when_it_is_resumed() {
    for stopped in [true, false] {
        // On a busy machine the interruption may come after the last gradient step.
        assert!((0..20).any(|_| is_interrupted_in_time_and_finished(stopped)));
    }
}

/// Interrupts a run after its last environment step, and resumes it. Returns false if no gradient steps were left.
fn is_interrupted_in_time_and_finished(stopped: bool) -> bool {
    let place = Workplace::new();
    let running = place.start_as("run", &SLOW_UPDATES);
    until("all steps are taken", || support::committed_rows(&running) == 1500);
    if stopped {
        // It fails if the run is over.
        let has_stopped = place.output(&["stop", "run"]).status.success();
        assert_eq!(running.wait().0, Some(0));
        if !has_stopped {
            return false;
        }
    } else {
        running.kill_all();
    }
    let status_at_rest = || {
        let output = place.output(&["status", "run", "--json"]);
        assert_eq!(output.status.code(), Some(3));
        support::json(&output)
    };
    let before = status_at_rest();
    if before["updates"] == 1436 {
        return false;
    }
    assert_eq!(before["finished"], false);

    let (code, printed, leftovers) = place.resume("run", &[]).wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let result = parse(&printed);
    assert_eq!((&result["env_steps"], &result["updates"]), (&1500.into(), &1436.into()));
    assert!(result["weights_sha256"].is_string() && result["eval_return_mean"].is_number());
    let evaluations = std::fs::read_to_string(place.path().join("run/evaluations.csv")).unwrap();
    assert!(evaluations.lines().last().unwrap().contains(",1500,"), "{evaluations}");

    assert_eq!(status_at_rest()["finished"], true);
    let message = error_line(&place.output(&["resume", "run"]));
    assert!(message.contains("already taken 1500 of 1500 steps"), "{message}");
    true
}

#[test]
fn a_run_of_some_episodes_ends_although_its_learner_is_slower_than_its_actors() {
    let place = Workplace::new();
    let limits = [
        "--episodes",
        "4",
        "--steps",
        "6000",
        "--set",
        "replay.tolerance=64",
        "--json",
    ];
    let arguments = [&["train", "pendulum", "--run", "run"], &SLOW_UPDATES[2..], &limits].concat();
    let output = place.output(&arguments);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let result = support::json(&output);
    let (steps, episodes) = (
        result["env_steps"].as_u64().unwrap(),
        result["episodes"].as_u64().unwrap(),
    );
    assert!(
        (4..10).contains(&episodes) && steps < 3000,
        "{steps} steps, {episodes} episodes"
    );
    // Every row was learned from.
    assert_eq!(result["updates"], steps - 64);
}

#[test]
fn stopping_a_waiting_copy_does_not_stop_the_original() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    place.copy("run", "copy");
    let mut waiting = place.shoal(&["resume", "copy"]).spawn().unwrap();
    let mut message = String::new();
    until("the copy's launcher waits", || {
        message = error_line(&place.output(&["stop", "copy"]));
        !message.contains("nothing runs")
    });
    assert!(
        message.contains("is a copy of") && message.contains(running.run.to_str().unwrap()),
        "{message}"
    );
    assert!(!place.output(&["scale", "copy", "--actors", "3"]).status.success());
    until("the copy's launcher gives up", || waiting.try_wait().unwrap().is_some());
    running.wait_for_learning();
    assert_eq!(place.status("run")["actors"], 2);
}

#[test]
fn a_signal_ends_a_resumed_run_in_order() {
    let place = Workplace::new();
    killed(&place, &[]);
    let resumed = place.resume("run", &[]);
    resumed.wait_for_learning();
    resumed.signal(Signal::TERM);
    let log = resumed.run.join("shoal.log");
    let (code, _, leftovers) = resumed.wait();
    assert_eq!(code, Some(143), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let log = std::fs::read_to_string(log).unwrap();
    assert!(log.contains("signal 15 (SIGTERM) ends the run"), "{log}");
    assert_eq!(
        support::json(&place.output(&["list", ".", "--json"]))["runs"][0]["state"],
        "stopped"
    );
}
