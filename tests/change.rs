//! The configuration of a run changes when it is resumed: by `--set`, by an edit of `config.toml`, and by `scale`.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::path::Path;

use serde_json::Value;
use shoal_common::commit::CommitReader;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;
use support::{Workplace, error_line, json, until};

/// Rows of `changes.csv` without their times.
fn changes(run: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(run.join("changes.csv")).unwrap();
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some("wall_seconds,env_steps,key,before,after,source"));
    lines.map(|line| line.split_once(',').unwrap().1.to_owned()).collect()
}

fn read(run: &Path, file: &str) -> String {
    std::fs::read_to_string(run.join(file)).unwrap()
}

/// Replaces a line of `config.toml`.
fn edit(run: &Path, line: &str, with: &str) {
    let text = read(run, "config.toml");
    assert!(text.contains(line), "{line}: {text}");
    std::fs::write(run.join("config.toml"), text.replacen(line, with, 1)).unwrap();
}

/// Resumes the run `run` to its end. Returns its result and what it said on standard error.
fn resume(place: &Workplace, arguments: &[&str]) -> (Value, String) {
    let output = place.output(&[&["resume", "run", "--json"], arguments].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {said}");
    (json(&output), said)
}

/// The error of a resume that must be refused, and its exit code.
fn refused(place: &Workplace, arguments: &[&str]) -> (String, i32) {
    let output = place.output(&[&["resume", "run"], arguments].concat());
    (error_line(&output), output.status.code().unwrap())
}

/// The files that a refused change must leave as they are.
fn files(run: &Path) -> Vec<Vec<u8>> {
    let names = [
        "config.toml",
        "config/used.toml",
        "changes.csv",
        "replay.bin",
        "checkpoints/latest.ckpt",
    ];
    names
        .iter()
        .map(|name| std::fs::read(run.join(name)).unwrap())
        .collect()
}

#[test]
fn rates_change_with_the_run_and_each_change_is_recorded_once() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "400", "--run", "run"]);
    let run = &place.path().join("run");
    assert_eq!(
        changes(run),
        Vec::<String>::new(),
        "the table has its header from the start"
    );

    let set = [
        "--set",
        "ddpg.tau=0.005",
        "--set",
        "exploration.sigma=0.3",
        "--set",
        "run.steps=0.6k",
    ];
    let (result, said) = resume(&place, &set);
    assert_eq!(result["env_steps"], 600);
    assert!(
        said.contains("ddpg.tau changes from 0.001 to 0.005 at step 400 (--set)"),
        "{said}"
    );
    let three = [
        "400,ddpg.tau,0.001,0.005,--set",
        "400,exploration.sigma,0.2,0.3,--set",
        "400,run.steps,400,600,--set",
    ];
    assert_eq!(changes(run), three);
    assert!(read(run, "config.toml").contains("tau = 0.005"));
    assert!(read(run, "shoal.log").contains("ddpg.tau changes from 0.001 to 0.005"));

    // The same again changes nothing but the length.
    resume(&place, &[&set[..4], &["--steps", "800"]].concat());
    assert_eq!(changes(run)[..3], three);
    assert_eq!(changes(run)[3..], ["600,run.steps,600,800,--steps"]);

    assert!(place.output(&["report", "run", "--out", "page.html"]).status.success());
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    let shown = page
        .split_once("id=\"data\">")
        .unwrap()
        .1
        .split_once("</script>")
        .unwrap()
        .0;
    let shown: Value = serde_json::from_str(shown).unwrap();
    assert_eq!(shown["runs"][0]["changes"][0]["key"], "ddpg.tau");
    assert_eq!(shown["runs"][0]["changes"].as_array().unwrap().len(), 4);
}

#[test]
fn a_change_that_is_not_possible_is_refused_and_its_key_named() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let run = &place.path().join("run");
    let before = files(run);
    for (set, part) in [
        (
            "ddpg.gamma=0.9",
            "ddpg.gamma = 0.9: cannot change in this run, which has 0.99: the rows in the replay were made with it",
        ),
        (
            "ddpg.hidden=[8]",
            "ddpg.hidden = [8]: cannot change in this run, which has [24, 16]: the networks keep",
        ),
        ("ddpg.activation=tanh", "ddpg.activation = tanh: cannot change"),
        ("run.seed=9", "run.seed = 9: cannot change"),
        ("run.mode=lockstep", "run.mode = lockstep: cannot change"),
        ("run.id=00", "run.id cannot be set"),
        ("replay.n_step=3", "replay.n_step = 3: cannot change"),
        ("replay.capacity=3000", "replay.capacity = 3000: cannot change"),
        ("replay.ratio_since=10", "replay.ratio_since cannot be set"),
        ("actors.max=20", "actors.max = 20: cannot change"),
        ("actors.count=17", "actors.count = 17: must be from 1 to 16"),
        (
            "environment.name=cart-pole",
            "environment.name = cart-pole: cannot change",
        ),
        (
            "environment.time_limit=100",
            "environment.time_limit = 100: cannot change",
        ),
        ("spec.time_limit=100", "spec.time_limit cannot be set"),
        (
            "sac.tau=0.1",
            "this run learns with ddpg, and the algorithm of a run cannot change",
        ),
        (
            "observation.normalise=true",
            "observation.normalise = true: cannot change",
        ),
        (
            "ddpg.batch=3000",
            "ddpg.batch = 3000: does not go with replay.capacity = 2000 (the run's own), which must be from 3000 to",
        ),
        (
            "environment.server=[\"x\"]",
            "environment.server = [\"x\"]: cannot change in this run, which has nothing",
        ),
        ("ddpg.tau=nan", "ddpg.tau = NaN: must be above 0 and at most 1"),
        ("ddpg.tau=-1", "ddpg.tau = -1: must be above 0"),
        ("ddpg.tau=quickly", "ddpg.tau = \"quickly\": must be a number"),
        ("ddpg.ta=0.1", "unknown field `ta`"),
        ("evaluation.every=0", "evaluation.every = 0: must be from 1"),
        (
            "replay.updates_per_step=inf",
            "replay.updates_per_step = inf: must be from 0 to 1000",
        ),
    ] {
        let (message, code) = refused(&place, &["--steps", "400", "--set", set]);
        assert!(message.contains(part), "{set}: {message}");
        assert_eq!(code, 2, "{set}: {message}");
        assert_eq!(files(run), before, "{set}: nothing has changed");
    }
    let (message, _) = refused(&place, &["--set", "ddpg.tau=0.5"]);
    assert!(message.contains("already taken 300 of 300 steps"), "{message}");
    assert_eq!(
        files(run),
        before,
        "a finished run needs more steps, and changes nothing without them"
    );
}

#[test]
fn an_edited_file_is_compared_key_by_key() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let run = &place.path().join("run");
    let original = read(run, "config.toml");
    let reason = || json(&place.output(&["list", ".", "--json"]))["runs"][0].clone();
    assert_eq!(reason()["reason"], Value::Null);

    edit(run, "gamma = 0.99", "gamma = 0.9");
    let (message, code) = refused(&place, &["--steps", "400"]);
    assert!(
        message.contains("config.toml, line ") && message.contains("ddpg.gamma = 0.9: cannot change"),
        "{message}"
    );
    assert_eq!(code, 1);
    let listed = reason();
    assert_eq!(listed["state"], "finished");
    assert!(
        listed["reason"]
            .as_str()
            .unwrap()
            .contains("ddpg.gamma = 0.9: cannot change"),
        "{listed}"
    );
    assert!(
        place.output(&["eval", "run", "--episodes", "1"]).status.success(),
        "the run's files are used as before"
    );

    for (text, part) in [
        ("", "missing field"),
        ("[run\n", "config.toml, line 1"),
        (
            &original.replace("tau = 0.001", "tau = 7"),
            "ddpg.tau = 7: must be above 0",
        ),
        (&original.replace("tau = 0.001", "tau = \"x\""), "ddpg.tau = \"x\""),
        (
            &original.replace("[ddpg]", "[sac]"),
            "[exploration] is the noise of ddpg",
        ),
        (&original.replace("seed = 1", "seed = 2"), "run.seed = 2: cannot change"),
        (
            &original.replace("time_limit = 200", "time_limit = 100"),
            "time_limit = 100: cannot change",
        ),
        (&format!("{original}\n[td3]\n"), "two algorithms"),
        (
            &original.replace("warmup = 64", "warmup = 64\nratio_since = 5"),
            "replay.ratio_since = 5: cannot change",
        ),
    ] {
        std::fs::write(run.join("config.toml"), text).unwrap();
        let (message, _) = refused(&place, &["--steps", "400"]);
        assert!(message.contains(part), "{part}: {message}");
    }

    // What may change is recorded; a comment stays, and so does what means the same.
    let changed = original
        .replace("tau = 0.001", "tau = 5e-3 # mine")
        .replace("every = 300", "every = 100");
    std::fs::write(run.join("config.toml"), &changed).unwrap();
    let listed = reason();
    let expected = "config.toml was edited, for the next resume: ddpg.tau = 0.005 instead of 0.001";
    assert!(listed["reason"].as_str().unwrap().starts_with(expected), "{listed}");
    resume(&place, &["--steps", "400"]);
    assert_eq!(
        changes(run),
        [
            "300,ddpg.tau,0.001,0.005,config.toml",
            "300,evaluation.every,300,100,config.toml",
            "300,run.steps,300,400,--steps",
        ]
    );
    assert_eq!(reason()["reason"], Value::Null);
    edit(run, "steps = 400", "steps = 500 # longer");
    resume(&place, &[]);
    assert!(
        read(run, "config.toml").contains("steps = 500 # longer"),
        "a file that says what is used is left alone"
    );
}

#[test]
fn a_kill_between_two_files_neither_loses_nor_repeats_a_change() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let run = &place.path().join("run");
    let (used, table) = (read(run, "config/used.toml"), read(run, "changes.csv"));
    resume(&place, &["--steps", "400", "--set", "ddpg.tau=0.005"]);
    let recorded = changes(run);
    assert_eq!(recorded.len(), 2);

    // Killed after the table and before the last file.
    std::fs::write(run.join("config/used.toml"), &used).unwrap();
    resume(&place, &["--steps", "500"]);
    assert_eq!(changes(run)[..2], recorded);
    assert_eq!(changes(run)[2..], ["400,run.steps,400,500,--steps"]);

    // Killed after the table, and then the edit was taken back.
    let now = read(run, "config/used.toml");
    resume(&place, &["--steps", "600", "--set", "ddpg.tau=0.007"]);
    std::fs::write(run.join("config/used.toml"), &now).unwrap();
    edit(run, "tau = 0.007", "tau = 0.005");
    resume(&place, &["--steps", "700"]);
    assert_eq!(
        changes(run)[5..],
        ["600,ddpg.tau,0.007,0.005,config.toml", "600,run.steps,600,700,--steps"]
    );

    // A line that was cut short.
    std::fs::write(run.join("changes.csv"), format!("{table}1.5,300,ddpg.t")).unwrap();
    resume(&place, &["--steps", "800"]);
    assert_eq!(changes(run), ["700,run.steps,700,800,--steps"]);
}

#[test]
fn the_ratio_of_a_free_run_counts_from_its_change_on() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "1064", "--run", "run"]);
    let run = &place.path().join("run");
    // 1,000 updates so far.
    let (result, _) = resume(&place, &["--steps", "1264", "--set", "replay.updates_per_step=0.5"]);
    assert_eq!(result["updates"], 1_000 + 100);
    let (result, _) = resume(&place, &["--steps", "1364", "--set", "replay.updates_per_step=2"]);
    assert_eq!(result["updates"], 1_100 + 200);
    let (result, _) = resume(&place, &["--steps", "1464"]);
    assert_eq!(result["updates"], 1_300 + 200, "it is kept");
    assert!(!read(run, "config.toml").contains("ratio_since"));
    let status = place.output(&["status", "run", "--json"]);
    assert_eq!(
        (&json(&status)["ratio"], &json(&status)["updates_per_step"]),
        (&2.0.into(), &2.0.into())
    );
}

#[test]
fn the_number_of_actors_changes_and_scaling_is_recorded_too() {
    for what in ["pendulum", "frozen-lake"] {
        let place = Workplace::new();
        let running = if what == "pendulum" {
            place.start("run", &["--steps", "100000000", "--actors", "4"])
        } else {
            let free = [
                "--set",
                "run.mode=free",
                "--steps",
                "100000000",
                "--episodes",
                "10000000",
                "--actors",
                "4",
            ];
            place.launch("run", &[&["train", what, "--run", "run"], &free[..]].concat())
        };
        running.wait_for_learning();
        let run = running.run.clone();
        // An edit while the run is running waits for the next resume, and scaling keeps it.
        edit(&run, "confirm = 2", "confirm = 3");
        assert!(place.output(&["scale", "run", "--actors", "3"]).status.success());
        assert_eq!(changes(&run).len(), 1);
        assert!(
            changes(&run)[0].ends_with(",actors.count,4,3,scale"),
            "{:?}",
            changes(&run)
        );
        assert!(read(&run, "config/used.toml").contains("count = 3"));
        assert!(read(&run, "config.toml").contains("count = 3") && read(&run, "config.toml").contains("confirm = 3"));
        running.kill("learner-0");
        until("the learner is replaced", || running.pids("learner-0").len() >= 2);
        running.wait_for_learning();
        assert!(place.output(&["stop", "run"]).status.success());
        running.wait();

        let resumed = place.resume("run", &["--set", "actors.count=1"]);
        resumed.wait_for_learning();
        assert_eq!(place.status("run")["actors"], 1);
        assert!(place.output(&["stop", "run"]).status.success());
        assert_eq!(resumed.wait().0, Some(0), "{}", place.stderr());
        let keys: Vec<String> = changes(&run)[1..]
            .iter()
            .map(|row| row.split(',').nth(1).unwrap().to_owned())
            .collect();
        assert_eq!(keys, ["actors.count", "evaluation.confirm"]);
    }
}

#[test]
fn a_copy_of_a_run_changes_alone() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "300", "--run", "original"]);
    place.copy("original", "run");
    resume(&place, &["--steps", "400", "--set", "ddpg.tau=0.005"]);
    assert_eq!(changes(&place.path().join("run")).len(), 2);
    assert_eq!(changes(&place.path().join("original")), Vec::<String>::new());
    assert!(place.output(&["resume", "original", "--steps", "400"]).status.success());
}

#[test]
fn the_best_policy_is_evaluated_with_the_new_number_of_episodes() {
    let place = Workplace::new();
    place.train(&["pendulum", "--steps", "300", "--run", "run"]);
    let (_, said) = resume(&place, &["--steps", "400", "--set", "evaluation.episodes=4"]);
    assert!(
        said.contains("the best policy is re-evaluated, because the number of episodes has changed"),
        "{said}"
    );
    // A finished run keeps its last policy as the best one with the mean of its final evaluation.
    let run = RunDir::open(&place.path().join("run")).unwrap();
    let layout = run.config().unwrap().policy_layout().unwrap();
    let mut best = PolicyFile::read(&run.best_policy(), &layout).unwrap();
    best.episodes = 3;
    best.write(&run.best_policy()).unwrap();
    let (_, said) = resume(&place, &["--steps", "500"]);
    assert!(
        said.contains("re-evaluated, because the final evaluation had another number of episodes"),
        "{said}"
    );
}

const LOCKSTEP: [&str; 4] = ["--lockstep", "--set", "checkpoint.every_updates=100", "--quiet"];

#[test]
fn a_lockstep_run_has_the_same_bits_after_the_same_change_at_the_same_step() {
    let place = Workplace::new();
    let changed = |name: &str, steps| {
        place.train(&[&["pendulum", "--steps", steps, "--run", name][..], &LOCKSTEP].concat());
        let set = ["--set", "ddpg.actor_learning_rate=0.01", "--set", "ddpg.batch=16"];
        let change = [&["resume", name, "--steps", "800", "--json"][..], &set].concat();
        let output = place.output(&change);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        json(&output)["weights_sha256"].clone()
    };
    let weights = [changed("first", "400"), changed("second", "400")];
    assert_eq!(weights[0], weights[1]);
    // The last round of 408 steps has no place for rows of the second actor.
    assert_eq!(changed("third", "408"), changed("fourth", "408"));
    place.train(&[&["pendulum", "--steps", "400", "--run", "run"][..], &LOCKSTEP].concat());
    let (result, _) = resume(&place, &["--steps", "800"]);
    assert_ne!(result["weights_sha256"], weights[0]);
    for (set, part) in [
        (
            "exploration.sigma=0.3",
            "cannot change in a lockstep run, which has 0.2: a part of its next round",
        ),
        (
            "actors.count=3",
            "cannot change in a lockstep run, which has 2: its results depend on it",
        ),
        ("replay.updates_per_step=0.5", "cannot change in a lockstep run"),
        ("replay.warmup=80", "cannot change in a lockstep run"),
        ("checkpoint.every_updates=50", "cannot change in a lockstep run"),
    ] {
        let (message, code) = refused(&place, &["--steps", "900", "--set", set]);
        assert!(message.contains(part) && code == 2, "{set}: {message}");
    }
}

#[test]
fn all_actors_send_the_same_number_of_chunks_even_in_a_shortened_last_round() {
    let place = Workplace::new();
    place.train(&[&["pendulum", "--steps", "408", "--run", "run"][..], &LOCKSTEP].concat());
    let commits = CommitReader::open(&place.path().join("run/replay.bin")).unwrap();
    let [first, second] = [0, 1].map(|actor| (commits.actor(actor).rows, commits.committed(actor).sequence));
    assert!(first.0 > second.0, "the last round is cut");
    assert_eq!(first.1, second.1);
}

#[test]
fn a_killed_lockstep_run_learns_from_its_rounds_before_its_rates_change() {
    let place = Workplace::new();
    let rarely = [
        "--lockstep",
        "--set",
        "checkpoint.every_updates=1000000",
        "--steps",
        "100000000",
    ];
    let running = place.start("run", &rarely);
    running.wait_for_learning();
    support::wait_for_rows(&running, 200);
    running.kill_all();
    let run = running.run.clone();
    let (message, code) = refused(&place, &["--set", "ddpg.tau=0.01"]);
    assert!(
        message.contains("ddpg.tau: cannot change now") && message.contains("shoal stop"),
        "{message}"
    );
    assert_eq!(code, 1);
    // What does not affect the bits may change.
    let resumed = place.resume("run", &["--set", "evaluation.confirm=0"]);
    resumed.wait_for_learning();
    assert!(place.output(&["stop", "run"]).status.success());
    assert_eq!(resumed.wait().0, Some(0));
    let resumed = place.resume("run", &["--set", "ddpg.tau=0.01"]);
    resumed.wait_for_learning();
    assert!(place.output(&["stop", "run"]).status.success());
    assert_eq!(resumed.wait().0, Some(0));
    let keys: Vec<String> = changes(&run)
        .iter()
        .map(|row| row.split(',').nth(1).unwrap().to_owned())
        .collect();
    assert_eq!(keys, ["evaluation.confirm", "ddpg.tau"]);
}
