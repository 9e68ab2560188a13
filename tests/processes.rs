//! The processes of a run start, become ready and end. However they end, they leave nothing behind.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::process::Command;
use std::time::Duration;

use rustix::process::{Pid, Resource, Rlimit, Signal, getrlimit, prlimit};
use shoal_common::channel::Domain;
use support::{QUICK, Workplace, contents, error_line, parse, until};

const ENDLESS: [&str; 2] = ["--steps", "100000000"];

#[test]
fn a_run_ends_by_itself_with_all_its_results() {
    let place = Workplace::new();
    let (code, printed, leftovers) = place.start("run", &["--steps", "1500", "--actors", "2"]).wait();
    assert_eq!(code, Some(0));
    let result = parse(&printed);
    assert_eq!(result["env_steps"], 1500);
    assert_eq!(result["updates"], 1500 - 64);
    assert_eq!(result["eval_episodes"], 3);
    assert!(result["eval_return_mean"].as_f64().unwrap() < 0.0);
    assert_eq!(result["weights_sha256"].as_str().unwrap().len(), 64);
    assert_eq!(
        result["run"],
        std::fs::canonicalize(place.path().join("run"))
            .unwrap()
            .to_str()
            .unwrap()
    );
    for file in [
        "config.toml",
        "episodes.csv",
        "evaluations.csv",
        "learner.csv",
        "learning-curve.svg",
        "shoal.log",
        "checkpoints/latest.ckpt",
        "checkpoints/last.policy",
        "replay.bin",
        "tensorboard",
    ] {
        assert!(place.path().join("run").join(file).exists(), "{file}");
    }
    assert!(leftovers.processes().is_empty(), "no process is left");
    assert!(leftovers.files().is_empty(), "{:?}", leftovers.files());
}

#[test]
fn ctrl_c_and_sigterm_end_a_run_and_save_its_state() {
    for (signal, code) in [(Signal::INT, 130), (Signal::TERM, 143)] {
        let place = Workplace::new();
        let running = place.start("run", &ENDLESS);
        until("something is learned", || running.learned("updates") > 0);
        running.signal(signal);
        let run = running.run.clone();
        let (exit, printed, leftovers) = running.wait();
        assert_eq!(exit, Some(code));
        let said = format!("signal {} (", code - 128);
        assert!(std::fs::read_to_string(run.join("shoal.log")).unwrap().contains(&said));
        assert!(parse(&printed)["env_steps"].as_u64().unwrap() > 0);
        assert!(run.join("checkpoints/latest.ckpt").exists());
        assert!(run.join("checkpoints/last.policy").exists());
        assert!(leftovers.processes().is_empty());
        assert!(leftovers.files().is_empty(), "{:?}", leftovers.files());
    }
}

#[test]
fn signals_that_were_ignored_at_the_start_stay_ignored() {
    let place = Workplace::new();
    let arguments = [
        &["train", "pendulum", "--run", "run", "--json"],
        &ENDLESS[..],
        &support::QUICK,
    ]
    .concat();
    let running = place.launch_command("run", &mut place.shoal_ignoring("HUP INT", &arguments));
    for signal in [Signal::HUP, Signal::INT] {
        running.signal(signal);
        running.wait_for_learning();
    }
    running.signal(Signal::TERM);
    let run = running.run.clone();
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(143), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    assert!(
        log.contains("signal 15 (SIGTERM) ends the run") && !log.contains("SIGINT") && !log.contains("SIGHUP"),
        "{log}"
    );
}

#[test]
fn when_the_launcher_is_killed_the_roles_save_their_state_end_and_leave_nothing_behind() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    until("something is learned", || running.learned("updates") > 0);
    let leftovers = running.leftovers();
    running.signal(Signal::KILL);
    leftovers.wait_until_gone();
    assert!(running.run.join("checkpoints/latest.ckpt").exists());
    assert!(
        running.run.join("checkpoints/last.policy").exists(),
        "the learner ended cleanly"
    );
}

#[test]
fn the_next_start_removes_what_a_killed_run_left_in_shared_memory() {
    let place = Workplace::new();
    let running = place.start("killed", &ENDLESS);
    let leftovers = running.leftovers();
    // Checked while the run lives: once it is killed, the start of any run, even another test's, removes its files.
    assert!(!leftovers.files().is_empty(), "the run has files in shared memory");
    running.kill_all();
    place.start("next", &["--steps", "100"]).wait();
    assert!(leftovers.files().is_empty(), "{:?}", leftovers.files());
}

#[test]
fn a_clean_up_whose_launcher_has_died_is_refused() {
    let place = Workplace::new();
    let clean_up = |launcher: u32| place.output(&["clean-up", &launcher.to_string(), "none"]);
    // No process has this id.
    let message = error_line(&clean_up(0));
    assert!(message.contains("the parent process has ended"), "{message}");
    assert!(clean_up(std::process::id()).status.success());
}

#[test]
fn a_run_without_free_file_descriptors_continues_when_there_are_some_again() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    let launcher = Pid::from_raw(running.launcher() as i32);
    let limit = |limit: Rlimit| prlimit(launcher, Resource::Nofile, limit).unwrap();
    // Descriptors that are open stay open.
    let before = limit(Rlimit {
        current: Some(3),
        ..getrlimit(Resource::Nofile)
    });
    running.kill("actor-0");
    let is_refused = |line: &&str| line.starts_with("actor-0 ") && line.contains("trying again in");
    until("the actor cannot be started", || {
        running.log().lines().filter(is_refused).count() >= 2
    });
    assert_eq!(running.pids("actor-0").len(), 1, "it was started once");
    limit(before);
    until("the actor is started again", || running.pids("actor-0").len() == 2);
    running.wait_for_learning();
    assert!(!running.log().contains("removed files"), "{}", running.log());
    running.signal(Signal::TERM);
    assert_eq!(running.wait().0, Some(143), "{}", place.stderr());
}

#[test]
fn a_run_whose_directory_cannot_be_inspected_for_a_moment_continues() {
    let place = Workplace::new();
    let running = place.start("above/run", &ENDLESS);
    running.wait_for_learning();
    let [above, moved] = ["above", "moved"].map(|name| place.path().join(name));
    std::fs::rename(&above, &moved).unwrap();
    // A link to itself: the system refuses to inspect what is below it, and does not say that it does not exist.
    std::os::unix::fs::symlink(&above, &above).unwrap();
    std::thread::sleep(Duration::from_secs(1));
    std::fs::remove_file(&above).unwrap();
    std::fs::rename(&moved, &above).unwrap();
    running.wait_for_learning();
    running.signal(Signal::TERM);
    assert_eq!(running.wait().0, Some(143), "{}", place.stderr());
}

#[test]
fn a_run_whose_files_in_tmp_are_removed_loses_nothing_and_continues() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    let root = Domain::directory_of(running.leftovers().run_id()).unwrap();
    // So that it does not notice before the other run has started.
    running.signal(Signal::STOP);
    let before = running.leftovers().files();
    std::fs::remove_dir_all(&root).unwrap();
    // As a terminal that asks makes it again, or a program that tidies up leaves it.
    std::fs::create_dir(&root).unwrap();
    place.start("next", &["--steps", "100"]).wait();
    let after = running.leftovers().files();
    assert!(
        !before.is_empty() && before.iter().all(|file| after.contains(file)),
        "{} files, then {}",
        before.len(),
        after.len()
    );
    let said = support::error_line(&place.output(&["status", "run"]));
    assert!(said.contains("another program has removed files"), "{said}");
    running.signal(Signal::CONT);
    let noticed = || {
        running
            .log()
            .matches("another program has removed files of this run")
            .count()
    };
    until("the launcher notices", || noticed() == 1);
    running.wait_for_learning();
    assert!(place.status("run")["env_steps"].as_u64().unwrap() > 0);

    // Only the files are removed, as by a program that deletes old files, and a role must be replaced.
    running.signal(Signal::STOP);
    // `find` fails if a file disappears before it reaches it.
    let find = Command::new("find").arg(&root).args(["-type", "f", "-delete"]).output();
    assert!(find.is_ok(), "{find:?}");
    running.kill("actor-0");
    running.signal(Signal::CONT);
    until("the launcher notices again", || noticed() == 2);
    running.wait_for_learning();
    let stopped = place.output(&["stop", "run"]);
    assert!(stopped.status.success(), "{}", String::from_utf8_lossy(&stopped.stderr));
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
}

#[test]
fn a_run_whose_directory_is_removed_or_replaced_ends_with_one_line() {
    for replaced in [false, true] {
        let place = Workplace::new();
        let running = place.start("run", &ENDLESS);
        running.wait_for_learning();
        let (leftovers, gone) = (running.leftovers(), place.path().join("gone"));
        std::fs::rename(&running.run, &gone).unwrap();
        if replaced {
            std::fs::create_dir(&running.run).unwrap();
            std::fs::write(running.run.join("config.toml"), "").unwrap();
        }
        let (run, log) = (running.run.clone(), gone.join("shoal.log"));
        let (code, printed) = running.wait_for_launcher();
        let said = place.stderr();
        let last = said.lines().last().unwrap();
        assert_eq!((code, printed.as_str()), (Some(1), ""), "{said}");
        assert!(
            last.starts_with("error: the run directory") && last.contains("removed or renamed"),
            "{said}"
        );
        assert!(!said.contains("resume"), "{said}");
        let log = std::fs::read_to_string(log).unwrap();
        assert!(log.contains("removed or renamed"), "{log}");
        assert!(log.contains("had lost the run's directory, and was killed"), "{log}");
        assert!(!log.contains("did not end when asked to"), "{log}");
        assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
        let there = std::fs::read_dir(&run).map_or(0, Iterator::count);
        assert_eq!(
            there,
            usize::from(replaced),
            "nothing is written into another directory"
        );
    }
}

#[test]
fn nothing_is_written_into_a_run_that_takes_the_place_of_one_in_its_final_evaluation() {
    let place = Workplace::new();
    // So many episodes that the evaluation takes seconds.
    let long = ["--steps", "500", "--set", "evaluation.final_episodes=10000"];
    let running = place.start_as("run", &[&QUICK[..8], &long].concat());
    let run = running.run.clone();
    let outcome = || std::fs::read_to_string(run.join("outcome.json")).unwrap_or_default();
    until("the final evaluation has begun", || {
        outcome().contains("final evaluation")
    });
    std::fs::rename(&run, place.path().join("kept")).unwrap();
    place.copy("kept", "run");
    let before = contents(&run);
    let (code, printed) = running.wait_for_launcher();
    let said = place.stderr();
    assert_eq!((code, printed.as_str()), (Some(1), ""), "{said}");
    let last = said.lines().last().unwrap();
    assert!(last.contains("removed or renamed"), "{said}");
    let after = contents(&run);
    let changed: Vec<_> = after
        .iter()
        .filter(|(path, bytes)| before.get(*path) != Some(bytes))
        .collect();
    assert!(changed.is_empty() && before.len() == after.len(), "{:?}", after.keys());
}

#[test]
fn a_killed_role_is_replaced_and_the_run_continues_to_its_end() {
    for who in ["actor-0", "env-server-0", "env-server-16", "evaluator-0", "learner-0"] {
        let place = Workplace::new();
        let running = place.start("run", &["--steps", "30000"]);
        until("something is learned", || running.learned("updates") > 0);
        running.kill(who);
        until("it is replaced", || running.pids(who).len() >= 2);
        let log = running.run.join("shoal.log");
        let (code, printed, leftovers) = running.wait();
        let log = std::fs::read_to_string(log).unwrap();
        assert_eq!(code, Some(0), "{who}: {log}");
        assert_eq!(parse(&printed)["env_steps"], 30000, "{who}");
        assert!(leftovers.files().is_empty(), "{who}: {:?}", leftovers.files());
    }
}

#[test]
fn a_role_that_keeps_failing_is_given_up_and_its_error_is_reported() {
    let place = Workplace::new();
    let running = place.start("run", &["--steps", "3000000"]);
    until("something is learned", || running.learned("updates") > 0);
    until("there is a checkpoint", || {
        running.run.join("checkpoints/latest.ckpt").exists()
    });
    // Stopped, so that it cannot save again in between.
    running.stop_role("learner-0");
    for name in ["latest.ckpt", "previous.ckpt"] {
        let file = running.run.join("checkpoints").join(name);
        if file.exists() {
            std::fs::write(file, b"damaged").unwrap();
        }
    }
    running.kill("learner-0");
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(1));
    let message = std::fs::read_to_string(place.path().join("stderr")).unwrap();
    let last = message.lines().last().unwrap();
    assert!(
        last.contains("learner-0 failed") && last.contains("times and is given up") && last.contains("latest.ckpt"),
        "{message}"
    );
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
}

#[test]
fn a_run_whose_shared_memory_cannot_be_cleaned_up_continues_in_new_shared_memory() {
    let place = Workplace::new();
    let running = place.start("run", &["--steps", "100000000"]);
    running.wait_for_learning();
    running.kill_beyond_cleaning("actor-0");
    until("new shared memory is reported", || {
        running.log().contains("continues in new shared memory")
    });
    running.wait_for_learning();
    running.wait_for_learning();
    assert!(place.output(&["stop", "run"]).status.success());
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
}
