//! Runs that were broken off go on: after the launcher was killed, after everything was, and after what a disk may do.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::os::unix::fs::FileExt;
use std::path::Path;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use shoal_common::commit::CommitReader;
use shoal_common::config::Config;
use support::{Running, Workplace, complaint, parse, until};

/// Rows of the quick runs' ring.
const RING: u64 = 2000;

const ENDLESS: [&str; 2] = ["--steps", "100000000"];

fn has_saved(running: &Running) {
    let there = |name: &str| running.run.join("checkpoints").join(name).exists();
    // A learner killed while it saves leaves the previous one alone.
    until("there are two checkpoints", || {
        there("previous.ckpt") && there("latest.ckpt")
    });
    until("there is a best policy", || there("best.policy"));
}

fn rows(run: &Path) -> u64 {
    CommitReader::open(&run.join("replay.bin")).unwrap().rows()
}

/// A run that has learned something, whose processes are all killed.
fn killed(place: &Workplace, arguments: &[&str]) -> std::path::PathBuf {
    let quickly = ["--set", "checkpoint.every_seconds=0.5"];
    let running = place.start("run", &[&ENDLESS[..], &quickly, arguments].concat());
    running.learns_on();
    has_saved(&running);
    running.kill_everybody();
    running.run.clone()
}

/// Goes on for so many steps more, to the end.
fn goes_on(place: &Workplace, more: u64) -> serde_json::Value {
    let steps = rows(&place.path().join("run")) + more;
    let (code, printed, leftovers) = place.resume("run", &["--steps", &steps.to_string()]).wait();
    assert_eq!(code, Some(0), "{}", place.said());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let result = parse(&printed);
    assert_eq!(result["env_steps"], steps);
    assert_eq!(result["updates"], steps - 64);
    result
}

#[test]
fn when_the_launcher_is_killed_the_run_can_be_resumed_at_once() {
    let place = Workplace::where_chunks_are_counted();
    let running = place.start("run", &ENDLESS);
    running.learns_on();
    let (run, before) = (running.run.clone(), rows(&running.run));
    running.signal(Signal::KILL);
    // The old roles may still be saving what they have.
    let resumed = place.resume("run", &[]);
    resumed.learns_on();
    assert!(rows(&run) > before);
    assert!(place.output(&["stop", "run"]).status.success());
    let (code, _, leftovers) = resumed.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    for actor in 0..2 {
        let (sent, committed) = (support::sent(&run, actor), support::committed(&run, actor as usize));
        // Between two launchers nobody writes down what an actor says of its last chunks: some tenth of a second's.
        assert!(
            (sent..sent + 2000).contains(&committed),
            "actor {actor} sent {sent}, {committed} are there"
        );
    }
}

#[test]
fn when_everything_is_killed_at_once_no_committed_row_is_lost() {
    let place = Workplace::new();
    let run = killed(&place, &[]);
    let before = rows(&run);
    assert!(before > 64);
    let status = place.output(&["status", "run", "--json"]);
    assert_eq!(status.status.code(), Some(3));
    assert_eq!(support::json(&status)["replay_rows"], before);
    goes_on(&place, 2000);
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    assert!(
        log.contains(&format!("of {before} rows")),
        "the learner began with all of them: {log}"
    );
}

#[test]
fn a_policy_of_a_period_that_was_evaluated_is_not_evaluated_again() {
    let place = Workplace::new();
    let running = place.start("run", &[&ENDLESS[..], &["--set", "evaluation.every=50000000"]].concat());
    let evaluations = running.run.join("evaluations.csv");
    let evaluated = || std::fs::read_to_string(&evaluations).unwrap().lines().count() - 1;
    until("the first policy is evaluated", || evaluated() == 1);
    running.kill("evaluator-0");
    until("it is replaced", || running.pids("evaluator-0").len() == 2);
    running.learns_on();
    assert!(place.output(&["stop", "run"]).status.success());
    running.wait();
    goes_on(&place, 2000);
    assert_eq!(evaluated(), 1);
}

#[test]
fn a_role_that_is_stopped_for_a_while_goes_on_and_nothing_is_there_twice() {
    stopped_for(Duration::from_secs(4));
}

#[test]
#[ignore = "takes minutes"]
fn a_role_that_is_stopped_for_half_a_minute_goes_on_and_nothing_is_there_twice() {
    stopped_for(Duration::from_secs(30));
}

/// Stops each role in turn, then the launcher, then everybody.
fn stopped_for(length: Duration) {
    let place = Workplace::where_chunks_are_counted();
    let running = place.start("run", &[&ENDLESS[..], &["--set", "replay.capacity=200000"]].concat());
    let run = running.run.clone();
    running.learns_on();
    for who in ["actor-0", "env-server-0", "evaluator-0", "env-server-16", "learner-0"] {
        running.stop(who);
        let begun = Instant::now();
        until("it is said to be silent", || {
            place.role("run", who)["state"] == "silent"
        });
        // How long it is stopped is the test.
        std::thread::sleep(length.saturating_sub(begun.elapsed()));
        running.go_on(who);
        running.learns_on();
    }
    running.signal(Signal::STOP);
    // So is this.
    std::thread::sleep(length);
    running.signal(Signal::CONT);
    running.learns_on();
    assert_eq!(place.status("run")["running"], true);

    assert!(place.output(&["stop", "run"]).status.success());
    let log = running.log();
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.files().is_empty());
    assert!(!log.contains("starting it again"), "{log}");
    support::all_that_was_sent_is_there(&run, 2);
}

#[test]
fn a_damaged_checkpoint_is_reported_and_the_one_before_it_used() {
    let place = Workplace::new();
    let running = place.start(
        "run",
        &[&ENDLESS[..], &["--set", "checkpoint.every_seconds=0.5"]].concat(),
    );
    has_saved(&running);
    // Stopped and not killed: both are there for certain.
    assert!(place.output(&["stop", "run"]).status.success());
    let run = running.run.clone();
    assert_eq!(running.wait().0, Some(0));
    let latest = run.join("checkpoints/latest.ckpt");
    let mut bytes = std::fs::read(&latest).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&latest, &bytes).unwrap();
    goes_on(&place, 500);
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    assert!(
        log.contains("latest.ckpt: is damaged") && log.contains("going on from"),
        "{log}"
    );
    assert_eq!(
        std::fs::read(run.join("checkpoints/damaged-0.ckpt")).unwrap(),
        bytes,
        "kept for inspection"
    );
}

#[test]
fn a_lost_counter_of_incarnations_keeps_nobody_from_going_on() {
    for counter in [None, Some("3")] {
        let place = Workplace::new();
        let run = killed(&place, &[]);
        // Now the replay knows of greater ones than those of a first start.
        goes_on(&place, 500);
        let file = run.join("incarnations");
        match counter {
            None => std::fs::remove_file(&file).unwrap(),
            Some(number) => std::fs::write(&file, number).unwrap(),
        }
        goes_on(&place, 500);
    }
}

#[test]
fn a_copy_of_a_run_that_goes_on_is_told_from_it() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.learns_on();
    place.copy("run", "copy");
    let said = complaint(&place.output(&["resume", "copy"]));
    assert!(
        said.contains("is a copy of") && said.contains(running.run.to_str().unwrap()),
        "{said}"
    );
    running.learns_on();
}

#[test]
fn what_is_not_this_runs_is_refused_in_one_line_and_left_as_it_is() {
    let place = Workplace::new();
    let run = killed(&place, &[]);
    let config = std::fs::read_to_string(run.join("config.toml")).unwrap();
    let replay = std::fs::read(run.join("replay.bin")).unwrap();

    // Another configuration.
    std::fs::write(run.join("config.toml"), config.replace("gamma = 0.99", "gamma = 0.9")).unwrap();
    let said = complaint(&place.output(&["resume", "run"]));
    assert!(said.contains("another configuration"), "{said}");
    std::fs::write(run.join("config.toml"), &config).unwrap();

    // A replay of another version: the second word of the file.
    let file = std::fs::File::options()
        .write(true)
        .open(run.join("replay.bin"))
        .unwrap();
    file.write_all_at(&99_u64.to_le_bytes(), 8).unwrap();
    let said = complaint(&place.output(&["resume", "run"]));
    assert!(said.contains("replay.bin") && said.contains("version is 99"), "{said}");
    file.write_all_at(&replay[8..16], 8).unwrap();

    // Another layout.
    std::fs::write(
        run.join("config.toml"),
        config.replace("capacity = 2000", "capacity = 3000"),
    )
    .unwrap();
    let (code, said) = resume_fails(&place);
    assert!(
        code == Some(1) && said.contains("its ring has 2000 rows, this run's 3000"),
        "{said}"
    );
    std::fs::write(run.join("config.toml"), &config).unwrap();

    assert_eq!(std::fs::read(run.join("replay.bin")).unwrap(), replay);
    goes_on(&place, 500);
}

/// A resumption whose learner is given up; what was said.
fn resume_fails(place: &Workplace) -> (Option<i32>, String) {
    let output = place.output(&["resume", "run"]);
    (
        output.status.code(),
        String::from_utf8_lossy(&output.stderr).into_owned(),
    )
}

#[test]
fn after_a_power_loss_the_replay_falls_back_to_what_it_can_prove() {
    // The newest rows never reached the disk, or none of those that the ring holds.
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
        goes_on(&place, 3000);
        let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
        let whole = format!("of {before} rows");
        let fell_back = log.contains("did not reach the disk") && !log.contains(&whole);
        assert!(log.contains("WARN") && (fell_back || lost == RING), "{log}");
    }
}

#[test]
fn a_role_that_cannot_start_is_given_up_with_its_last_words_and_the_run_can_be_resumed() {
    let place = Workplace::new();
    let run = killed(&place, &[]);
    // What the evaluator cannot read.
    let best = run.join("checkpoints/best.policy");
    let bytes = std::fs::read(&best).unwrap();
    std::fs::write(&best, b"not a policy at all").unwrap();
    let (code, said) = resume_fails(&place);
    assert_eq!(code, Some(1));
    assert!(
        said.contains("evaluator-0 failed") && said.contains("times and is given up") && said.contains("best.policy"),
        "{said}"
    );
    assert!(said.contains("shoal resume"), "{said}");
    std::fs::write(&best, bytes).unwrap();
    goes_on(&place, 500);
}

/// Networks and batches with which updates come long after their rows.
const SLOW_UPDATES: [&str; 14] = [
    "--steps",
    "3000",
    "--set",
    "replay.tolerance=1000000",
    "--set",
    "replay.warmup=64",
    "--set",
    "ddpg.hidden=[300, 300]",
    "--set",
    "ddpg.batch=256",
    "--set",
    "evaluation.every=3000",
    "--set",
    "evaluation.final_episodes=3",
];

#[test]
fn a_run_that_was_broken_off_after_its_last_row_is_finished_when_it_is_resumed() {
    for stopped in [true, false] {
        let place = Workplace::new();
        let running = place.start_as("run", &SLOW_UPDATES);
        until("all rows are there", || support::rows_of(&running) == 3000);
        if stopped {
            assert!(place.output(&["stop", "run"]).status.success());
            assert_eq!(running.wait().0, Some(0));
        } else {
            running.kill_everybody();
        }
        let rest = || {
            let output = place.output(&["status", "run", "--json"]);
            assert_eq!(output.status.code(), Some(3));
            support::json(&output)
        };
        let before = rest();
        assert!(
            before["updates"].as_u64().unwrap() < 2936,
            "it was broken off too late: {before}"
        );
        assert_eq!(before["finished"], false);

        let (code, printed, leftovers) = place.resume("run", &[]).wait();
        assert_eq!(code, Some(0), "{}", place.said());
        assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
        let result = parse(&printed);
        assert_eq!((&result["env_steps"], &result["updates"]), (&3000.into(), &2936.into()));
        assert!(result["weights_sha256"].is_string() && result["eval_return_mean"].is_number());
        let evaluations = std::fs::read_to_string(place.path().join("run/evaluations.csv")).unwrap();
        assert!(evaluations.lines().last().unwrap().contains(",3000,"), "{evaluations}");

        assert_eq!(rest()["finished"], true);
        let said = complaint(&place.output(&["resume", "run"]));
        assert!(said.contains("3000 of 3000 steps already"), "{said}");
    }
}

#[test]
fn a_copy_that_waits_for_the_original_is_no_way_to_stop_the_original() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.learns_on();
    place.copy("run", "copy");
    let mut waiting = place.shoal(&["resume", "copy"]).spawn().unwrap();
    let mut said = String::new();
    until("the copy's launcher waits", || {
        said = complaint(&place.output(&["stop", "copy"]));
        !said.contains("nothing runs")
    });
    assert!(
        said.contains("is a copy of") && said.contains(running.run.to_str().unwrap()),
        "{said}"
    );
    assert!(!place.output(&["scale", "copy", "--actors", "3"]).status.success());
    until("the copy's launcher gives up", || waiting.try_wait().unwrap().is_some());
    running.learns_on();
    assert_eq!(place.status("run")["actors"], 2);
}
