//! Suites of runs: `shoal train --seeds` and `--sweep`, their continuation and their report.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::path::Path;
use std::process::{Child, Stdio};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use shoal_common::channel::Domain;
use shoal_run::suite::Suite;
use support::{QUICK, Workplace, error_line, json, parse, until};

/// Trains the suite `suite` of the pendulum and returns what it printed and said.
fn train(place: &Workplace, arguments: &[&str]) -> (Value, String) {
    let output = place.output(
        &[
            &["train", "pendulum", "--run", "suite", "--json"],
            arguments,
            &QUICK[..],
        ]
        .concat(),
    );
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {said}");
    (json(&output), said)
}

#[test]
fn a_suite_trains_each_combination_with_each_seed_and_is_compared() {
    let place = Workplace::new();
    let arguments = [
        "--seeds",
        "1..2",
        "--sweep",
        "ddpg.tau=0.001,0.01",
        "--steps",
        "200",
        "--jobs",
        "2",
    ];
    let (printed, said) = train(&place, &arguments);
    let names = [
        "tau=0.001,seed=1",
        "tau=0.001,seed=2",
        "tau=0.01,seed=1",
        "tau=0.01,seed=2",
    ];
    let runs = printed["runs"].as_array().unwrap();
    assert_eq!(
        runs.iter().map(|run| run["run"].as_str().unwrap()).collect::<Vec<_>>(),
        names
    );
    for run in runs {
        assert!(
            run["finished"] == true && run["env_steps"] == 200 && run["eval_return_mean"].is_f64(),
            "{printed}"
        );
    }
    assert_ne!(
        runs[0]["eval_return_mean"], runs[1]["eval_return_mean"],
        "the seeds differ"
    );
    for (name, seed, tau) in [(names[1], 2, 0.001), (names[2], 1, 0.01)] {
        let path = place.path().join("suite").join(name).join("config.toml");
        let config = shoal_common::config::Config::load(&path).unwrap();
        assert_eq!((config.run.seed, config.algorithm.ddpg().unwrap().tau), (seed, tau));
        assert_eq!(config.learner.threads, 1);
    }
    assert!(
        said.contains("4 of 4 runs to train") && said.contains("tau=0.01,seed=2: done, return -"),
        "{said}"
    );
    assert!(said.contains("ddpg.tau = 0.001: -"), "a line for each setting: {said}");
    assert!(said.contains("of the resamples"), "and how certain the best is: {said}");

    // A run whose final evaluation was ended by a signal is evaluated; it is not trained again.
    let first = place.path().join("suite").join(names[0]);
    let outcome = || -> Value { parse(&std::fs::read_to_string(first.join("outcome.json")).unwrap()) };
    let mut ended = outcome();
    ended["reason"] = "the final evaluation was ended by signal 2 (SIGINT)".into();
    std::fs::write(first.join("outcome.json"), ended.to_string()).unwrap();
    std::fs::remove_file(first.join("final-evaluation.json")).unwrap();
    // The run is evaluated, although nothing can be recorded for TensorBoard.
    let (records, kept) = (first.join("tensorboard"), first.join("kept"));
    std::fs::rename(&records, &kept).unwrap();
    std::fs::write(&records, "").unwrap();
    let (again, said) = train(&place, &arguments);
    std::fs::remove_file(&records).unwrap();
    std::fs::rename(&kept, &records).unwrap();
    assert!(again == printed && said.contains("1 of 4 runs to train"), "{said}");
    assert!(
        said.contains("the final evaluation is not in TensorBoard's records"),
        "{said}"
    );
    assert_eq!(outcome()["reason"], Value::Null);

    // The same command has nothing left to do; another one is refused.
    let (again, said) = train(&place, &arguments);
    assert!(again == printed && said.contains("0 of 4 runs to train"), "{said}");
    let other = ["train", "pendulum", "--run", "suite", "--seeds", "1..3"];
    let message = error_line(&place.output(&other));
    assert!(message.contains("suite is a suite of other runs"), "{message}");

    // A command that takes one run names the runs of the suite.
    for command in [
        &["eval"][..],
        &["film"],
        &["status"],
        &["plot"],
        &["top"],
        &["stop"],
        &["scale", "--actors", "2"],
        &["export", "--format", "onnx"],
        &["export", "--minari", "x/y-v0"],
    ] {
        let message = error_line(&place.output(&[command, &["suite"]].concat()));
        assert!(
            message.contains("a suite of runs (tau=0.01,seed=1, tau=0.01,seed=2, tau=0.001,seed=1, and 1 more")
                && message
                    .trim_end()
                    .ends_with("name one of them, as in suite/tau=0.01,seed=1"),
            "{command:?}: {message}"
        );
    }

    let listed = json(&place.output(&["list", "suite", "--json"]));
    assert_eq!(listed["runs"].as_array().unwrap().len(), 4);
    let above = json(&place.output(&["list", ".", "--json"]));
    let found = &above["suites"][0];
    assert_eq!(
        (&found["path"], &found["runs"], &found["begun"]),
        (&"./suite".into(), &4.into(), &4.into()),
        "{above}"
    );
    let report = place.output(&["report", "suite"]);
    assert!(report.status.success(), "{}", String::from_utf8_lossy(&report.stderr));
    let page = std::fs::read_to_string(place.path().join("suite/report.html")).unwrap();
    let shown = page
        .split_once("id=\"data\">")
        .unwrap()
        .1
        .split_once("</script>")
        .unwrap()
        .0;
    let shown: Value = serde_json::from_str(shown).unwrap();
    let command = shown["suite"]["command"].as_str().unwrap();
    assert!(
        command.starts_with("shoal train pendulum --run suite --json --seeds 1..2 "),
        "{command}"
    );
    let of_run = shown["runs"][0]["start"]["command"].as_str().unwrap();
    assert!(of_run.contains(" --seed 1 --run "), "{of_run}");
    let places = shown["rankings"][0]["places"].as_array().unwrap();
    assert_eq!(places.len(), 2, "{places:?}");
    assert!(places[0]["mean"].as_f64() >= places[1]["mean"].as_f64());
    let shares: f64 = places.iter().map(|place| place["best"].as_f64().unwrap()).sum();
    assert!(
        (shares - 1.0).abs() < 1e-9 && places[0]["interval"][0].is_f64(),
        "{places:?}"
    );

    let replays = || {
        let there = |name: &&&str| place.path().join("suite").join(name).join("replay.bin").exists();
        names.iter().filter(there).count()
    };
    assert!(place.output(&["rm", "suite", "--replay", "--yes"]).status.success());
    assert_eq!(replays(), 0);
    std::fs::write(place.path().join("suite/notes.txt"), "mine").unwrap();
    assert!(place.output(&["rm", "suite", "--yes"]).status.success());
    let left = std::fs::read_dir(place.path().join("suite")).unwrap();
    let left: Vec<_> = left.map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left, ["notes.txt"], "what the suite did not make stays");
}

/// Settings with which a run takes seconds.
const SLOW: [&str; 6] = [
    "--set",
    "ddpg.hidden=[300, 300]",
    "--set",
    "ddpg.batch=256",
    "--set",
    "replay.tolerance=64",
];

fn start(place: &Workplace, arguments: &[&str]) -> Child {
    let mut command = place.shoal(arguments);
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Updates that the run has recorded.
fn learned(run: &Path) -> usize {
    std::fs::read_to_string(run.join("learner.csv")).map_or(0, |text| text.lines().count())
}

#[test]
fn an_interrupted_or_killed_suite_continues_where_it_was() {
    let place = Workplace::new();
    let suite = [
        "train", "pendulum", "--run", "suite", "--seeds", "3,1", "--steps", "2000", "--jobs", "1",
    ];
    let arguments = [&suite[..], &QUICK, &SLOW].concat();
    // As after a kill before the suite was written.
    std::fs::create_dir(place.path().join("suite")).unwrap();
    std::fs::write(place.path().join("suite/suite.json.new"), "{").unwrap();
    let first = place.path().join("suite/seed=3");
    let mut suite = start(&place, &arguments);
    until("the first run learns", || learned(&first) > 2);
    kill_process(Pid::from_child(&suite), Signal::INT).unwrap();
    assert_eq!(suite.wait().unwrap().code(), Some(130));
    let rows = || {
        json(&place.output(&["status", first.to_str().unwrap(), "--json"]))["replay_rows"]
            .as_u64()
            .unwrap()
    };
    let before = rows();
    assert!((1..2_000).contains(&before), "{before}");
    assert!(!place.path().join("suite/seed=1").exists());

    let mut suite = start(&place, &["resume", "suite"]);
    until("it goes on", || rows() > before);
    let message = error_line(&place.output(&["resume", "suite"]));
    assert!(message.contains("another process works on the suite"), "{message}");
    kill_process(Pid::from_child(&suite), Signal::KILL).unwrap();
    suite.wait().unwrap();
    // At once: its training may still be ending.
    let output = place.output(&["resume", "suite", "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let runs = json(&output)["runs"].clone();
    assert_eq!(
        (&runs[0]["env_steps"], &runs[1]["env_steps"]),
        (&2_000.into(), &2_000.into()),
        "{runs}"
    );
    let _ = Domain::remove_abandoned();
}

#[test]
fn a_run_of_a_suite_that_was_stopped_is_not_done() {
    let place = Workplace::new();
    let suite = [
        "train", "pendulum", "--run", "suite", "--seeds", "3,1", "--steps", "2000", "--jobs", "1",
    ];
    let mut command = place.shoal(&[&suite[..], &QUICK, &SLOW].concat());
    let training = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let first = place.path().join("suite/seed=3");
    until("the first run learns", || learned(&first) > 2);
    assert!(place.output(&["stop", "suite/seed=3"]).status.success());
    let output = training.wait_with_output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("seed=3: failed: it was stopped before its end") && !said.contains("seed=3: done"),
        "{said}"
    );
    assert!(
        said.contains("seed=1: done") && said.contains(", 1 of 2 runs"),
        "{said}"
    );
    assert!(
        said.contains("error: 1 of the runs failed; to continue with them: shoal resume "),
        "{said}"
    );
    let output = place.output(&["resume", "suite", "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(json(&output)["runs"][0]["env_steps"], 2_000);
}

#[test]
fn with_halving_bad_settings_are_ended_early_also_after_a_kill() {
    let place = Workplace::new();
    let command = [
        &["train", "pendulum", "--run", "suite", "--halving", "--jobs", "1"][..],
        &["--sweep", "ddpg.actor_learning_rate=1e-9,1e-4,1e-8", "--steps", "2000"],
        &["--set", "evaluation.every=200"],
        &QUICK,
        &SLOW,
    ]
    .concat();
    let too_late = error_line(&place.output(&[&command[..], &["--set", "evaluation.every=501"]].concat()));
    assert!(too_late.contains("the first evaluation comes after 501"), "{too_late}");
    let alone = error_line(&place.output(&["train", "pendulum", "--halving", "--sweep", "ddpg.tau=0.1"]));
    assert!(alone.contains("give several with --sweep"), "{alone}");

    let mut first = start(&place, &command);
    let path = place.path().join("suite");
    let ended = || {
        let text = std::fs::read_to_string(path.join("suite.json")).unwrap_or_default();
        let suite: Value = serde_json::from_str(&text).unwrap_or_default();
        suite["halving"]["ended"].as_array().map_or(0, Vec::len)
    };
    until("the first round is over", || ended() == 1);
    kill_process(Pid::from_child(&first), Signal::KILL).unwrap();
    first.wait().unwrap();
    let is_running = |run: std::fs::DirEntry| {
        let run = shoal_common::run_dir::RunDir::open(&run.path());
        run.is_ok_and(|run| run.is_running().unwrap())
    };
    until("no training is running", || {
        !std::fs::read_dir(&path).unwrap().flatten().any(is_running)
    });

    // The runs have the suite's length, not the preset's.
    let message = error_line(&place.output(&["resume", "suite", "--set", "evaluation.every=1500"]));
    assert!(message.contains("the first evaluation comes after 1500"), "{message}");
    let output = place.output(&["resume", "suite", "--json"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    assert!(
        said.contains("ended early at 50 %") && !said.contains("at 25 %"),
        "{said}"
    );
    let runs = json(&output)["runs"].as_array().unwrap().clone();
    let best = |run: &Value| -> f64 {
        let file = path.join(run["run"].as_str().unwrap()).join("evaluations.csv");
        let mut rows = csv::Reader::from_path(file).unwrap();
        let headers = rows.headers().unwrap().clone();
        let column = |name: &str| headers.iter().position(|header| header == name).unwrap();
        let (mean, updates) = (column("return_mean"), column("updates"));
        // Policies that have learned nothing do not count.
        let learned = rows.records().map(Result::unwrap).filter(|row| &row[updates] != "0");
        let means = learned.map(|row| row[mean].parse::<f64>().unwrap());
        means.fold(f64::NEG_INFINITY, f64::max)
    };
    let (ended, left): (Vec<&Value>, Vec<&Value>) = runs.iter().partition(|run| run["ended_early"] == true);
    assert_eq!((ended.len(), left.len()), (2, 1), "{runs:?}");
    assert_eq!(
        (&left[0]["finished"], &left[0]["env_steps"]),
        (&true.into(), &2000.into())
    );
    for run in ended {
        let steps = run["env_steps"].as_u64().unwrap();
        assert!((500..2000).contains(&steps) && run["finished"] == false, "{run}");
        assert!(best(run) <= best(left[0]), "{runs:?}");
    }
    let _ = Domain::remove_abandoned();
}

#[test]
fn a_suite_is_changed_and_continued() {
    let place = Workplace::new();
    let sweep = [
        "--seeds",
        "1..2",
        "--sweep",
        "ddpg.critic_learning_rate=1e-3,1e-4",
        "--steps",
        "200",
        "--jobs",
        "2",
    ];
    train(&place, &sweep);
    let suite = place.path().join("suite");
    let file = || std::fs::read_to_string(suite.join("suite.json")).unwrap();
    let before = file();
    for (refused, part) in [
        ("ddpg.critic_learning_rate=1", "the runs of this suite differ in it"),
        ("run.seed=3", "the runs of this suite differ in it"),
        ("ddpg.gamma=0.5", "ddpg.gamma"),
        ("ddpg.gama=0.5", "gama"),
    ] {
        let message = error_line(&place.output(&["resume", "suite", "--set", refused]));
        assert!(message.contains(part), "{message}");
        assert_eq!(file(), before, "nothing is changed by {refused}");
    }

    // A run that has not begun gets the changes too.
    std::fs::remove_dir_all(suite.join("critic_learning_rate=1e-4,seed=2")).unwrap();
    let changed = [
        "resume",
        "suite",
        "--json",
        "--jobs",
        "2",
        "--steps",
        "300",
        "--set",
        "ddpg.tau=0.004",
    ];
    for _ in 0..2 {
        let output = place.output(&changed);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let runs = json(&output)["runs"].clone();
        for run in runs.as_array().unwrap() {
            assert_eq!(
                (&run["env_steps"], &run["finished"]),
                (&300.into(), &true.into()),
                "{run}"
            );
            let path = suite.join(run["run"].as_str().unwrap()).join("config.toml");
            let config = shoal_common::config::Config::load(&path).unwrap();
            assert_eq!((config.run.steps, config.algorithm.ddpg().unwrap().tau), (300, 0.004));
        }
    }
    let recorded = std::fs::read_to_string(suite.join("critic_learning_rate=1e-3,seed=1/changes.csv")).unwrap();
    assert_eq!(recorded.matches("ddpg.tau").count(), 1, "changed once: {recorded}");
    // The command that made the suite continues it, with its changes.
    let (again, said) = train(&place, &sweep);
    assert!(
        again["runs"][0]["env_steps"] == 300 && said.contains("0 of 4 runs to train"),
        "{said}"
    );
}

#[test]
fn a_suite_that_waits_for_an_environment_is_interrupted() {
    let place = Workplace::new();
    let started = place.path().join("started");
    // This server never describes itself.
    let server = format!(
        r#"environment.server=["sh","-c","touch '{}'; exec sleep 1000"]"#,
        started.display()
    );
    // Without an answer to the signal, it would be waited for all day.
    let settings = [server, "environment.start_seconds=86_400".into()];
    let settings = settings
        .into_iter()
        .flat_map(|setting| ["--set".into(), setting])
        .collect();
    let suite = Suite::new("gym:Pendulum-v1".into(), settings, &[], &[1, 2]).unwrap();
    let directory = place.path().join("suite");
    std::fs::create_dir(&directory).unwrap();
    suite.write(&directory).unwrap();
    let mut resumed = start(&place, &["resume", "suite", "--quiet"]);
    until("the server is started", || started.exists());
    kill_process(Pid::from_child(&resumed), Signal::INT).unwrap();
    until("the command has ended", || resumed.try_wait().unwrap().is_some());
    assert_eq!(resumed.wait().unwrap().code(), Some(130));
}

#[test]
fn a_failed_run_does_not_stop_the_others() {
    let place = Workplace::new();
    // So many layers diverge with the first rate after a few updates.
    let deep = "ddpg.hidden=[64, 64, 64, 64, 64, 64, 64, 64]";
    let sweep = [
        "--sweep",
        "ddpg.critic_learning_rate=1,1e-4",
        "--steps",
        "300",
        "--jobs",
        "1",
    ];
    let arguments = [
        &["train", "pendulum", "--run", "suite"],
        &sweep[..],
        &QUICK,
        &["--set", deep, "--set", "run.give_up_seconds=1"],
    ]
    .concat();
    let output = place.output(&arguments);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(
        said.contains("rate=1: failed: ") && said.contains("the losses are no longer finite"),
        "{said}"
    );
    assert!(
        said.contains("rate=1e-4: done, return -") && said.contains(", 1 of 2 runs"),
        "{said}"
    );
    assert!(
        said.contains("error: 1 of the runs failed; to continue with them: shoal resume "),
        "{said}"
    );
}

#[test]
fn invalid_suite_arguments_are_refused_before_anything_is_created() {
    let place = Workplace::new();
    for (arguments, part) in [
        (&["--seeds", "5..1"][..], "must look like 1..5"),
        (&["--seeds", "1,1"], "names a seed twice"),
        (&["--sweep", "tau=1,2"], "must look like SECTION.KEY=A,B,C"),
        (&["--sweep", "ddpg.tau=0.1,0.1"], "names a value twice"),
        (&["--sweep", "run.seed=1,2"], "use --seeds"),
        (&["--sweep", "ddpg.tau=0.1,2"], "ddpg.tau = 2: must be above 0"),
        (&["--sweep", "ddpg.ta=0.1,0.2"], "unknown field `ta`"),
        (
            &["--sweep", "ddpg.tau=0.1", "--sweep", "ddpg.tau=0.2"],
            "was given twice",
        ),
        (&["--jobs", "2"], "--jobs: only for several runs"),
    ] {
        let output = place.output(&[&["train", "pendulum", "--run", "suite"], arguments].concat());
        let message = error_line(&output);
        assert!(message.contains(part), "{arguments:?}: {message}");
        assert!(!place.path().join("suite").exists(), "{arguments:?}");
    }
    std::fs::create_dir(place.path().join("mine")).unwrap();
    let message = error_line(&place.output(&["train", "pendulum", "--run", "mine", "--seeds", "1..2"]));
    assert!(message.contains("mine exists already"), "{message}");
}
