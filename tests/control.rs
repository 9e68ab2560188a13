//! Commands that observe and control a run from another terminal: status, scale, stop, resume.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::io::BufRead;
use std::process::{Command, Output, Stdio};

use rustix::process::Signal;
use serde_json::Value;
use support::{Workplace, json, parse, until};

const ENDLESS: [&str; 2] = ["--steps", "100000000"];

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

fn roles<'a>(status: &'a Value, name: &str) -> Vec<&'a Value> {
    let all = status["roles"].as_array().unwrap().iter();
    all.filter(|role| role["role"] == name).collect()
}

#[test]
fn status_shows_every_role_of_a_run_and_reports_when_nothing_runs() {
    let place = Workplace::new();
    let running = place.start("run", &[&ENDLESS[..], &["--actors", "2"]].concat());
    running.wait_for_learning();
    let status = place.status("run");
    assert_eq!(status["running"], true);
    for (role, count) in [("learner", 1), ("evaluator", 1), ("actor", 2), ("env-server", 3)] {
        let found = roles(&status, role);
        assert_eq!(found.len(), count, "{role}: {status}");
        for role in found {
            let pids = running.pids(&format!("{}-{}", role["role"].as_str().unwrap(), role["index"]));
            assert_eq!(role["pid"].as_i64(), pids.last().map(|pid| i64::from(*pid)));
            assert_eq!(role["restarts"], 0);
        }
    }
    assert!(status["env_steps"].as_u64().unwrap() > 0 && status["updates"].as_u64().unwrap() > 0);
    assert!(status["replay_rows"].as_u64() >= status["env_steps"].as_u64());
    assert_eq!(status["actors"], 2);
    assert!(status["ratio"].as_f64().unwrap() <= 1.0);
    let waiting = status.get("waiting").unwrap();
    assert!(
        waiting.is_null() || waiting.as_str().is_some_and(|who| who.contains("wait")),
        "{waiting}"
    );

    let table = place.output(&["status", "run"]);
    let table = String::from_utf8_lossy(&table.stdout).into_owned();
    for part in ["learner 0", "actor 1", "env-server 16", "ratio"] {
        assert!(table.contains(part), "{table}");
    }

    running.kill("actor-1");
    until("the restart is counted", || {
        roles(&place.status("run"), "actor")[1]["restarts"] == 1
    });

    assert!(place.output(&["stop", "run"]).status.success());
    running.wait();
    let output = place.output(&["status", "run", "--json"]);
    assert_eq!(output.status.code(), Some(3));
    let after = json(&output);
    assert_eq!(
        (&after["running"], &after["roles"]),
        (&false.into(), &Value::Array(vec![]))
    );
    assert!(after["updates"].as_u64() > status["updates"].as_u64());
    let output = place.output(&["status", "run"]);
    assert_eq!(output.status.code(), Some(3));
    assert!(String::from_utf8_lossy(&output.stdout).contains("shoal resume run"));
}

#[test]
fn status_watch_follows_a_run_to_its_end() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    let mut watch = place
        .shoal(&["status", "run", "--watch", "--json"])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let printed = std::io::BufReader::new(watch.stdout.take().unwrap()).lines();
    let (sender, received) = std::sync::mpsc::channel();
    std::thread::spawn(move || printed.map_while(Result::ok).try_for_each(|line| sender.send(line)));
    let mut lines: Vec<Value> = Vec::new();
    let mut receive = || {
        let new = received.try_iter().map(|line| serde_json::from_str(&line).unwrap());
        lines.extend(new);
        lines.len()
    };
    until("two lines are printed", || receive() >= 2);
    assert!(place.output(&["stop", "run"]).status.success());
    running.wait();
    until("the watching command ends", || watch.try_wait().unwrap().is_some());
    assert!(watch.wait().unwrap().success());
    lines.extend(
        received
            .iter()
            .map(|line| serde_json::from_str::<Value>(&line).unwrap()),
    );
    let (last, before) = lines.split_last().unwrap();
    assert!(before.iter().all(|line| line["running"] == true), "{lines:?}");
    assert_eq!(last["running"], false);
}

#[test]
fn scaling_actors_during_training_loses_no_rows() {
    let place = Workplace::logging_chunks();
    let running = place.start("run", &[&ENDLESS[..], &["--actors", "1"]].concat());
    for actors in [4, 2, 3, 1] {
        let output = place.output(&["scale", "run", "--actors", &actors.to_string()]);
        assert!(output.status.success(), "{}", stderr(&output));
        let status = place.status("run");
        assert_eq!(status["actors"], actors);
        assert_eq!(roles(&status, "actor").len(), actors, "{status}");
        until("the retired actors' environment servers have ended", || {
            roles(&place.status("run"), "env-server").len() == actors + 1
        });
        running.wait_for_learning();
    }
    for (actors, part) in [("0", "1 to 16 actors"), ("17", "1 to 16 actors")] {
        let output = place.output(&["scale", "run", "--actors", actors]);
        assert!(
            !output.status.success() && stderr(&output).contains(part),
            "{}",
            stderr(&output)
        );
    }
    assert_eq!(place.status("run")["actors"], 1);
    let run = running.run.clone();
    let stopped = place.output(&["stop", "run"]);
    assert!(stopped.status.success(), "{}", stderr(&stopped));
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    support::assert_all_rows_committed(&run, 4);
}

#[test]
fn a_stop_stores_everything_sent_even_if_the_learner_is_far_behind() {
    let place = Workplace::logging_chunks();
    let slow = ["--set", "replay.warmup=64", "--set", "actors.chunk_steps=64"];
    let running = place.start_as("run", &[&ENDLESS[..], &slow].concat());
    // The learner needs more than a second for two windows of 512 rows.
    until("the actors wait", || {
        let sent = support::sent(&running.run, 0);
        sent >= support::committed(&running.run, 0) + 512 && support::sent(&running.run, 1) > 0
    });
    let run = running.run.clone();
    assert!(place.output(&["stop", "run"]).status.success());
    running.wait();
    support::assert_all_rows_committed(&run, 2);
}

#[test]
fn a_run_that_ends_without_saving_the_learners_state_fails() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    running.stop_role("learner-0");
    let stopped = place.output(&["stop", "run"]);
    assert_eq!(stopped.status.code(), Some(1));
    assert!(
        stderr(&stopped).contains("did not save its last state"),
        "{}",
        stderr(&stopped)
    );
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(1));
    assert!(
        place.stderr().contains("did not save its last state"),
        "{}",
        place.stderr()
    );
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
}

#[test]
fn a_learner_killed_just_before_a_stop_is_replaced_before_the_run_ends() {
    let place = Workplace::logging_chunks();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    running.kill("learner-0");
    let stopped = place.output(&["stop", "run"]);
    assert!(stopped.status.success(), "{}", stderr(&stopped));
    let run = running.run.clone();
    running.wait();
    support::assert_all_rows_committed(&run, 2);
}

#[test]
fn a_learner_killed_just_before_a_signal_is_replaced_before_the_run_ends() {
    let place = Workplace::logging_chunks();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    // The launcher learns of the death and of the signal at the same time, in either order.
    running.signal(Signal::STOP);
    running.kill("learner-0");
    running.signal(Signal::TERM);
    running.signal(Signal::CONT);
    let run = running.run.clone();
    let (code, ..) = running.wait();
    assert_eq!(code, Some(128 + 15), "{}", place.stderr());
    support::assert_all_rows_committed(&run, 2);
    let incidents = std::fs::read_to_string(run.join("incidents.csv")).unwrap();
    for what in ["learner,0,killed", "learner,0,started-again"] {
        assert_eq!(incidents.matches(what).count(), 1, "{incidents}");
    }
}

#[test]
fn a_stop_that_comes_after_the_last_step_is_refused() {
    let place = Workplace::new();
    let long = ["--steps", "3000", "--set", "evaluation.final_episodes=5000"];
    let running = place.start("run", &long);
    let is_done = |line: &str| line.starts_with("learner-0 ") && line.ends_with(" done");
    until("the learner is done", || running.log().lines().any(is_done));
    running.signal(Signal::STOP);
    let stop = place.shoal(&["stop", "run"]).stderr(Stdio::piped()).spawn().unwrap();
    std::thread::sleep(std::time::Duration::from_millis(500));
    running.signal(Signal::CONT);
    let refused = stop.wait_with_output().unwrap();
    assert_eq!(refused.status.code(), Some(1));
    let (why, evaluating) = (stderr(&refused), "its final evaluation is under way");
    assert!(why.contains(evaluating) || why.contains("it is finished"), "{why}");
    running.wait();
}

#[test]
fn a_stopped_run_resumes_where_it_stopped() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.wait_for_learning();
    assert!(place.output(&["scale", "run", "--actors", "3"]).status.success());
    let run = running.run.clone();
    let stopped = place.output(&["stop", "run"]);
    assert!(String::from_utf8_lossy(&stopped.stdout).contains("shoal resume run"));
    let (code, printed, leftovers) = running.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.files().is_empty());
    let before = parse(&printed);
    for file in [
        "learning-curve.svg",
        "checkpoints/latest.ckpt",
        "checkpoints/last.policy",
    ] {
        assert!(run.join(file).exists(), "{file}");
    }
    let stop_again = place.output(&["stop", "run"]);
    assert!(!stop_again.status.success() && stderr(&stop_again).contains("nothing runs"));

    let steps = before["env_steps"].as_u64().unwrap() + 20_000;
    let running = place.resume("run", &["--steps", &steps.to_string()]);
    assert_eq!(
        roles(&place.status("run"), "actor").len(),
        3,
        "as scaled before the stop"
    );
    let busy = place.output(&["resume", "run"]);
    assert!(
        !busy.status.success() && stderr(&busy).contains("is already running"),
        "{}",
        stderr(&busy)
    );
    let pids = running.pids("learner-0").len();
    let (code, printed, _) = running.wait();
    assert_eq!((code, pids), (Some(0), 2));
    let after = parse(&printed);
    assert_eq!(after["env_steps"], steps);
    assert_eq!(
        after["updates"],
        steps - 64,
        "the updates of both parts, each counted once"
    );
    assert!(after["episodes"].as_u64() > before["episodes"].as_u64());

    for (arguments, part) in [
        (&["resume", "run"][..], "raise the limit with --steps"),
        (&["resume", "run", "--steps", "10"], "raise the limit with --steps"),
        (&["resume", "nowhere"], "nowhere is not a run directory"),
        (&["status", "nowhere"], "nowhere is not a run directory"),
        (&["scale", "run", "--actors", "2"], "nothing runs"),
        (&["scale", "run", "--actors", "2"], "it is finished; `shoal resume"),
        (&["stop", "run"], &format!("--steps N` with N above {steps}")),
    ] {
        let output = place.output(arguments);
        assert_eq!(output.status.code(), Some(1));
        assert!(
            stderr(&output).contains(part) && stderr(&output).lines().count() == 1,
            "{}",
            stderr(&output)
        );
    }
}

#[test]
fn a_lockstep_run_cannot_be_scaled() {
    let place = Workplace::new();
    let running = place.start("run", &[&ENDLESS[..], &["--lockstep"]].concat());
    let output = place.output(&["scale", "run", "--actors", "3"]);
    assert!(
        !output.status.success() && stderr(&output).contains("lockstep"),
        "{}",
        stderr(&output)
    );
    assert_eq!(place.status("run")["actors"], 2);
    drop(running);
}

#[test]
fn a_launcher_that_does_not_answer_is_reported() {
    let place = Workplace::new();
    let running = place.start("run", &ENDLESS);
    running.signal(rustix::process::Signal::STOP);
    let output = place.output(&["status", "run"]);
    running.signal(rustix::process::Signal::CONT);
    assert_eq!(output.status.code(), Some(1));
    assert!(stderr(&output).contains("does not answer"), "{}", stderr(&output));
    running.wait_for_learning();
}

/// Ends what a test has detached, even if it fails.
struct Detached<'a>(&'a Workplace, &'static str);

impl Drop for Detached<'_> {
    fn drop(&mut self) {
        self.0.output(&["stop", self.1]);
    }
}

#[test]
fn a_detached_run_has_a_session_of_its_own_and_works_when_the_command_returns() {
    let place = Workplace::new();
    let begin = ["train", "pendulum", "--run", "run", "--detach", "--json"];
    let output = place.output(&[&begin[..], &ENDLESS, &support::QUICK].concat());
    let _run = Detached(&place, "run");
    assert!(output.status.success(), "{}", stderr(&output));
    assert!(stderr(&output).contains("runs by itself"), "{}", stderr(&output));
    let launcher = json(&output)["pid"].as_i64().unwrap();
    let pid = rustix::process::Pid::from_raw(launcher as i32);
    assert_eq!(
        rustix::process::getsid(pid).unwrap(),
        pid.unwrap(),
        "a terminal's hang-up does not reach it"
    );
    let status = place.status("run");
    assert_eq!(status["running"], true);
    assert_eq!(roles(&status, "learner").len(), 1);
    let again = place.output(&["resume", "run", "--detach"]);
    assert!(!again.status.success());
    assert!(stderr(&again).contains("is already running"), "{}", stderr(&again));

    assert!(place.output(&["stop", "run"]).status.success());
    let changed = place.output(&[
        "resume",
        "run",
        "--detach",
        "--quiet",
        "--set",
        "ddpg.tau=0.01",
        "--steps",
        "90000000",
    ]);
    assert!(
        changed.status.success() && changed.stderr.is_empty(),
        "{}",
        stderr(&changed)
    );
    let status = place.status("run");
    assert_eq!(
        (status["running"].as_bool(), status["steps"].as_u64()),
        (Some(true), Some(90_000_000))
    );
    let changes = std::fs::read_to_string(place.path().join("run/changes.csv")).unwrap();
    assert!(changes.contains("ddpg.tau,0.001,0.01"), "{changes}");
}

#[test]
fn a_detached_run_that_cannot_start_is_refused_in_the_terminal_and_leaves_nothing() {
    let place = Workplace::new();
    for (limit, option, code, message) in [
        ("true", "--set=ddpg.tao=1", 2, "did you mean `tau`"),
        ("ulimit -n 64", "--quiet", 1, "the limit is 64"),
    ] {
        let mut shell = Command::new("sh");
        shell.args([
            "-c",
            &format!("{limit}; exec \"$@\""),
            "sh",
            env!("CARGO_BIN_EXE_shoal"),
        ]);
        shell.args(["train", "pendulum", "--run", "run", "--detach", option]);
        let output = shell.current_dir(place.path()).output().unwrap();
        assert_eq!(output.status.code(), Some(code), "{}", stderr(&output));
        assert!(stderr(&output).contains(message), "{}", stderr(&output));
        assert_eq!(stderr(&output).lines().count(), 1, "{}", stderr(&output));
        assert!(!place.path().join("run").exists(), "{option}");
    }
}

#[test]
fn a_detached_suite_is_trained_to_its_end() {
    let place = Workplace::new();
    let begin = [
        "train", "pendulum", "--run", "suite", "--seeds", "1..2", "--steps", "200", "--detach",
    ];
    let output = place.output(&[&begin[..], &support::QUICK].concat());
    assert!(output.status.success(), "{}", stderr(&output));
    let are_finished = |steps: u64| {
        let listed = json(&place.output(&["list", "suite", "--json"]));
        let runs = listed["runs"].as_array().unwrap().clone();
        let is_finished = |run: &Value| run["state"] == "finished" && run["steps"] == steps;
        runs.len() == 2 && runs.iter().all(is_finished)
    };
    until("both runs are finished", || are_finished(200));

    // The process that has trained them may work on the suite for a moment longer.
    until("the suite is resumed", || {
        let resumed = place.output(&["resume", "suite", "--steps", "400", "--detach"]);
        resumed.status.success()
    });
    until("both runs are finished again", || are_finished(400));
    for run in ["suite/seed=1", "suite/seed=2"] {
        let changes = std::fs::read_to_string(place.path().join(run).join("changes.csv")).unwrap();
        assert_eq!(changes.matches("run.steps,200,400").count(), 1, "{changes}");
    }
    until("a change that cannot be made is refused in the terminal", || {
        let refused = place.output(&["resume", "suite", "--set", "run.seed=3", "--detach"]);
        refused.status.code() == Some(2) && stderr(&refused).contains("the runs of this suite differ in it")
    });
}
