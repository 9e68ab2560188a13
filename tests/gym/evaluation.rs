//! Evaluations that fail, are killed or are ended by a signal.

use std::process::Stdio;

use rustix::process::{Pid, Signal, kill_process};

use crate::helpers::{OURS, SHORT, place, processes_of, server_of};
use crate::support::{self, Leftovers, QUICK, Workplace, error_line, parse, until};

/// The arguments of a run whose environment fails in the final evaluation. No other evaluation is due.
fn with_a_finale(how: &str) -> Vec<&str> {
    vec!["--steps", "200", "--set", "evaluation.every=1000000", "--set", how]
}

fn outcome_of(place: &Workplace) -> serde_json::Value {
    parse(&std::fs::read_to_string(place.path().join("run/outcome.json")).unwrap())
}

pub(crate) fn a_failure_in_the_final_evaluation_costs_an_episode_or_a_line() {
    let environment = format!("{OURS}Finale-v0");
    let found = |place: &Workplace| place.path().join("run/final-evaluation.json").exists();
    let place_of_one = place();
    let running = place_of_one.start_in("run", &environment, &with_a_finale("environment.how=once"));
    let (code, printed, _) = running.wait();
    assert_eq!(code, Some(0), "{}", place_of_one.stderr());
    assert!(place_of_one.path().join("final").exists(), "it has failed once");
    assert!(found(&place_of_one) && parse(&printed)["eval_episodes"] == 3);

    let place = place();
    let running = place.start_in("run", &environment, &with_a_finale("environment.how=always"));
    let (code, printed, leftovers) = running.wait();
    let said = place.stderr();
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("the final evaluation failed") && said.contains("the last act fails"),
        "{said}"
    );
    assert_eq!(parse(&printed)["env_steps"], 200);
    assert_eq!(parse(&printed)["eval_return_mean"], serde_json::Value::Null);
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    assert!(!found(&place) && outcome_of(&place)["state"] == "finished");
    let output = place.output(&["export", "run", "--format", "onnx"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

pub(crate) fn a_signal_ends_the_final_evaluation_in_order() {
    for (signal, code) in [(Signal::TERM, 143), (Signal::INT, 130)] {
        let place = place();
        let environment = format!("{OURS}Finale-v0");
        let train = ["train", &environment, "--run", "run", "--json"];
        // Not `start_in`: so short a run may end before its evaluator was ready.
        let mut running = place
            .shoal(&[&train[..], &with_a_finale("environment.how=sleeps"), &QUICK].concat())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        until("the final evaluation is asleep", || place.path().join("final").exists());
        assert_eq!(place.status("run")["waiting"], "final evaluation");
        let refused = error_line(&place.output(&["stop", "run"]));
        assert!(refused.contains("its final evaluation is under way"), "{refused}");
        kill_process(Pid::from_child(&running), signal).unwrap();
        until("it has ended", || running.try_wait().unwrap().is_some());
        let output = running.wait_with_output().unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{said}");
        assert_eq!(support::json(&output)["env_steps"], 200);
        let leftovers = Leftovers::of(&place.path().join("run"));
        assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
        assert!(processes_of(&place, "shoal_gym").is_empty());
        let outcome = outcome_of(&place);
        assert_eq!(outcome["state"], "finished");
        let why = format!("signal {}", code - 128);
        assert!(outcome["reason"].to_string().contains(&why), "{outcome}");
        assert!(place.path().join("run/checkpoints/best.policy").exists());
    }
}

pub(crate) fn a_signal_ends_shoal_eval_in_order() {
    for (signal, code) in [(Signal::TERM, 143), (Signal::INT, 130)] {
        let place = place();
        let environment = format!("{OURS}Sleeps-v0");
        let arguments = [&SHORT[..], &["--steps", "200"]].concat();
        let (trained, _, leftovers) = place.start_in("run", &environment, &arguments).wait();
        assert_eq!(trained, Some(0), "{}", place.stderr());
        std::fs::write(place.path().join("sleep"), "").unwrap();
        let temporary = place.path().join("temporary");
        std::fs::create_dir(&temporary).unwrap();
        let mut evaluation = place
            .shoal(&["eval", "run", "--json"])
            .env("TMPDIR", &temporary)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        until("it is asleep", || place.path().join("asleep").exists());
        kill_process(Pid::from_child(&evaluation), signal).unwrap();
        until("it has ended", || evaluation.try_wait().unwrap().is_some());
        let output = evaluation.wait_with_output().unwrap();
        assert_eq!(output.status.code(), Some(code));
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(said.lines().count() == 1 && said.contains("signal"), "{said}");
        assert!(output.stdout.is_empty());
        assert!(processes_of(&place, "shoal_gym").is_empty(), "its server has ended");
        assert_eq!(
            std::fs::read_dir(&temporary).unwrap().count(),
            0,
            "nothing of it is left"
        );
        assert!(leftovers.files().is_empty());
    }
}

pub(crate) fn an_evaluator_killed_while_it_confirms_a_policy_repeats_nothing_it_reported() {
    let place = place();
    let server = server_of("holding_server", "2");
    let arguments = [
        "--lockstep",
        "--steps",
        "1000",
        "--envs",
        "2",
        "--set",
        "evaluation.every=200",
    ];
    let running = place.start_in(
        "run",
        &format!("{OURS}Grows-v0"),
        &[&arguments[..], &["--set", &server]].concat(),
    );
    until("a policy is being confirmed", || place.path().join("held").exists());
    running.kill("evaluator-0");
    std::fs::write(place.path().join("go"), "").unwrap();
    let run = running.run.clone();
    let (code, _, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.stderr());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    let mut evaluations = csv::Reader::from_path(run.join("evaluations.csv")).unwrap();
    let column = |name: &str, row: &csv::StringRecord, headers: &csv::StringRecord| {
        row[headers.iter().position(|header| header == name).unwrap()].to_owned()
    };
    let headers = evaluations.headers().unwrap().clone();
    let rows: Vec<_> = evaluations.records().map(Result::unwrap).collect();
    let periods: Vec<u64> = rows
        .iter()
        .map(|row| column("env_steps", row, &headers).parse::<u64>().unwrap() / 200)
        .collect();
    assert_eq!(periods, (0..=5).collect::<Vec<_>>(), "each period once");
    assert!(rows.iter().all(|row| column("best", row, &headers) == "1"), "{rows:?}");
}
