//! A new run begins with the networks of another one, and with its replay: `train --from RUN --with-replay`. Or it begins
//! with the rows of a dataset: `train --demonstrations DATASET`.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Output;

use serde_json::Value;
use shoal_common::config::{AlgorithmConfig, Config, ReturnWeighting};
use shoal_run::testing::dataset;
use support::{Workplace, error_line, json};

/// A short lockstep run in `old`. Returns its result.
fn old(place: &Workplace, more: &[&str]) -> Value {
    place.train(&[&["pendulum", "--run", "old", "--steps", "300", "--lockstep"], more].concat())
}

/// Trains `what` in `new` with these arguments and the shortest evaluations. Returns its result and what it said.
fn begin(place: &Workplace, what: &str, arguments: &[&str]) -> (Value, String) {
    let short = [
        "--set",
        "evaluation.episodes=2",
        "--set",
        "evaluation.final_episodes=2",
        "--json",
    ];
    let output = place.output(&[&["train", what, "--from", "old"], arguments, &short].concat());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments:?}: {said}");
    (json(&output), said)
}

fn config(run: &Path) -> Config {
    Config::load(&run.join("config/used.toml")).unwrap()
}

#[test]
fn a_run_begins_with_the_weights_of_another_one_and_takes_their_shapes() {
    let place = Workplace::new();
    let before = old(&place, &[]);
    // No update is due before the end.
    let idle = [
        "--run",
        "new",
        "--steps",
        "200",
        "--set",
        "environment.start_speed=1",
        "--set",
        "ddpg.gamma=0.9",
    ];
    let (result, said) = begin(&place, "pendulum", &idle);
    assert_eq!(result["weights_sha256"], before["weights_sha256"]);
    assert_eq!((&result["updates"], &result["env_steps"]), (&0.into(), &200.into()));
    let run = place.path().join("new");
    let origin: Value = serde_json::from_str(&std::fs::read_to_string(run.join("origin.json")).unwrap()).unwrap();
    let there = place.path().join("old").canonicalize().unwrap();
    assert_eq!(origin["run"], there.to_str().unwrap());
    assert_eq!((&origin["updates"], &origin["env_steps"]), (&236.into(), &300.into()));
    assert_eq!(
        (&origin["weights_sha256"], &origin["rows"]),
        (&before["weights_sha256"], &0.into())
    );
    let expected = format!("new begins with the networks of {} after 236 updates", there.display());
    assert!(said.contains(&expected), "{said}");
    assert!(
        std::fs::read_to_string(run.join("shoal.log"))
            .unwrap()
            .contains(&expected)
    );
    let config = config(&run);
    assert_eq!(*config.algorithm.ddpg().unwrap().hidden, [24, 16]);
    assert_eq!(
        (config.algorithm.gamma(), config.run.from.as_deref()),
        (0.9, there.to_str())
    );
    assert!(place.output(&["report", "new", "--out", "page.html"]).status.success());
    assert!(
        std::fs::read_to_string(place.path().join("page.html"))
            .unwrap()
            .contains("after 236 updates")
    );

    // Other seeds and lengths learn on from there.
    let (result, _) = begin(
        &place,
        "pendulum",
        &["--run", "later", "--steps", "400", "--set", "replay.warmup=100"],
    );
    assert_eq!(result["updates"], 300);
    assert_ne!(result["weights_sha256"], before["weights_sha256"]);

    std::fs::remove_file(run.join("origin.json")).unwrap();
    let message = error_line(&place.output(&["resume", "new", "--steps", "300"]));
    assert!(message.contains("new was interrupted while it copied"), "{message}");
}

#[test]
fn a_policy_that_has_learned_acts_in_the_warm_up_too() {
    let place = Workplace::new();
    old(&place, &[]);
    let returns = |run: &str, warmup: &str| {
        let set = ["--run", run, "--steps", "400", "--lockstep", "--set", warmup];
        begin(&place, "pendulum", &set);
        let text = std::fs::read_to_string(place.path().join(run).join("episodes.csv")).unwrap();
        let returns = text.lines().map(|line| line.split(',').nth(6).unwrap().to_owned());
        let mut returns: Vec<String> = returns.collect();
        returns.sort();
        returns
    };
    let by_policy = returns("policy", "exploration.warmup=policy");
    assert!(by_policy.len() > 1, "{by_policy:?}");
    assert_eq!(returns("uniform", "exploration.warmup=uniform"), by_policy);
}

#[test]
fn a_run_takes_the_replay_along_and_counts_its_steps_from_there() {
    let place = Workplace::new();
    old(&place, &[]);
    let arguments = [
        "--with-replay",
        "--steps",
        "200",
        "--set",
        "replay.warmup=64",
        "--set",
        "replay.capacity=1000",
    ];
    let mut weights = Vec::new();
    for run in ["new", "again"] {
        let (result, said) = begin(
            &place,
            "pendulum",
            &[&arguments[..], &["--run", run, "--lockstep"]].concat(),
        );
        assert_eq!((&result["env_steps"], &result["updates"]), (&500.into(), &200.into()));
        assert!(
            said.contains("and with 300 rows of its replay") && !said.contains("warning"),
            "{said}"
        );
        weights.push(result["weights_sha256"].clone());
    }
    assert_eq!(
        weights[0], weights[1],
        "in lockstep the same beginning has the same end"
    );
    let (free, _) = begin(&place, "pendulum", &[&arguments[..], &["--run", "free"]].concat());
    assert_eq!((&free["env_steps"], &free["updates"]), (&500.into(), &200.into()));

    // The old rows are the first ones.
    let width = 4 * config(&place.path().join("new")).row_layout().width();
    let rows = |run: &str| {
        let config = config(&place.path().join(run));
        let bytes = std::fs::read(place.path().join(run).join("replay.bin")).unwrap();
        let ring = shoal_learner::process::replay_layout(&config).ring as usize * width;
        bytes[bytes.len() - ring.next_multiple_of(4096)..][..300 * width].to_vec()
    };
    assert_eq!(rows("new"), rows("old"));

    let output = place.output(&["resume", "new", "--steps", "600", "--json"]);
    assert_eq!(
        json(&output)["updates"],
        300,
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );

    // Of another run's configuration, only its own steps count.
    let output = place.output(&["train", "new/config.toml", "--run", "third", "--quiet"]);
    assert!(output.status.success(), "{}", error_line(&output));
    assert_eq!(config(&place.path().join("third")).run.steps, 300);

    let other = [
        &arguments[..],
        &["--run", "faster", "--set", "environment.start_speed=1"],
    ]
    .concat();
    let (_, said) = begin(&place, "pendulum", &other);
    assert!(
        said.contains("warning: the rows of") && said.contains("environment.start_speed = "),
        "{said}"
    );
}

#[test]
fn what_does_not_fit_is_refused_and_leaves_no_run() {
    let place = Workplace::new();
    old(&place, &[]);
    let refused = |arguments: &[&str]| {
        let output = place.output(&[&["train"], arguments, &["--run", "new"]].concat());
        let message = error_line(&output);
        assert!(!place.path().join("new").exists(), "{message}");
        (message, output.status.code())
    };
    for (arguments, part) in [
        (&["pendulum", "--from", "nowhere"][..], "nowhere is not a run directory"),
        (
            &["pendulum", "--method", "sac", "--from", "old"],
            "it has networks of ddpg, and this run learns with sac",
        ),
        (
            &["pendulum-sac", "--set", "sac.tau=0.1", "--from", "old"],
            "it has networks of ddpg",
        ),
        (
            &["pendulum", "--from", "old", "--set", "ddpg.hidden=[8]"],
            "its networks have another shape: ddpg.hidden = [24, 16]",
        ),
        (
            &["pendulum", "--from", "old", "--set", "observation.normalise=true"],
            "its networks have another shape: observation.normalise = false",
        ),
        (
            &["point-mass-r1", "--from", "old"],
            "its networks are for other observations",
        ),
        (
            &["pendulum", "--from", "old", "--set", "run.from=there"],
            "run.from cannot be set",
        ),
        (
            &["pendulum", "--from", "old", "--with-replay", "--set", "ddpg.gamma=0.9"],
            "γ is 0.99 in",
        ),
        (
            &["pendulum", "--from", "old", "--with-replay", "--set", "replay.n_step=3"],
            "replay.n_step is 1 in",
        ),
    ] {
        let (message, code) = refused(arguments);
        assert!(message.contains(part), "{arguments:?}: {message}");
        assert!(
            code == Some(2) || part.starts_with("nowhere"),
            "{arguments:?}: {message}"
        );
    }
    assert!(place.output(&["rm", "old", "--replay", "--yes"]).status.success());
    let (message, _) = refused(&["pendulum", "--from", "old", "--with-replay"]);
    assert!(message.contains("has no replay: leave out --with-replay"), "{message}");
    begin(&place, "pendulum", &["--run", "without", "--steps", "100"]);

    let running = place.start("running", &["--steps", "100000000"]);
    running.wait_for_learning();
    let (message, _) = refused(&["pendulum", "--from", "running", "--with-replay"]);
    assert!(message.contains("is running, and its replay with it"), "{message}");
}

#[test]
fn exploration_and_the_kind_of_networks_follow_the_run_that_a_new_one_begins_with() {
    let begun = |preset: &str, old: &[&str], new: &[&str]| {
        let place = Workplace::new();
        let output = place.output(&[&["train", preset, "--run", "old", "--quiet"], old].concat());
        assert!(output.status.success(), "{}", error_line(&output));
        begin(&place, preset, &[&["--run", "new", "--quiet"], new].concat());
        config(&place.path().join("new")).algorithm
    };
    let size = ["--method", "dqn", "--set", "dqn.hidden=[8]", "--set", "dqn.batch=8"];
    let old = [&size[..], &["--steps", "200", "--set", "dqn.epsilon_end=0.2"]].concat();
    let new = ["--method", "dqn", "--steps", "100", "--set", "dqn.batch=8"];
    let AlgorithmConfig::Dqn(dqn) = begun("cart-pole", &old, &new) else {
        panic!("another algorithm")
    };
    assert_eq!((dqn.epsilon_start, dqn.epsilon_end), (0.2, 0.05));

    let old = ["--episodes", "3", "--set", "reinforce.weight=baseline"];
    let AlgorithmConfig::Reinforce(reinforce) = begun("cart-pole", &old, &["--episodes", "3"]) else {
        panic!("another algorithm")
    };
    assert_eq!(reinforce.weight, ReturnWeighting::Baseline);
}

/// Rows of a pendulum: s, a, r, whether it was terminated, s', last.
fn demonstrated() -> Vec<[f32; 10]> {
    let row = |number: usize| {
        let x = number as f32 / 100.0;
        let last = f32::from(number % 20 == 19);
        [x, -x, 2.0 * x, 1.0 - x, -x, f32::from(number == 39), x, x, -x, last]
    };
    (0..100).map(row).collect()
}

/// A `python3` that says what the package `shoal` says about a dataset with these rows. Any other dataset is missing.
fn python(place: &Workplace, rows: &[[f32; 10]]) {
    let header = format!(
        "dataset = \"pendulum/hand-v0\"\nepisodes = 5\nrows = {}\n\
         observation = {{ box = {{ low = [-1.0, -1.0, -8.0], high = [1.0, 1.0, 8.0] }} }}\n\
         action = {{ box = {{ low = [-2.0], high = [2.0] }} }}\n",
        rows.len()
    );
    std::fs::write(place.path().join("rows"), dataset(&header, rows)).unwrap();
    std::fs::create_dir_all(place.path().join("bin")).unwrap();
    let program = place.path().join("bin/python3");
    let here = place.path().display();
    std::fs::write(
        &program,
        format!(
            "#!/bin/sh\n[ \"$1\" = -c ] && exit\n[ \"$4\" = pendulum/hand-v0 ] && exec cat '{here}/rows'\n\
             echo a warning >&2; echo 'error: there is none' >&2; echo >&2; exit 1\n"
        ),
    )
    .unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
}

/// Calls the program with that `python3`.
fn with_python(place: &Workplace, arguments: &[&str]) -> Output {
    let path = format!("{}/bin:/usr/bin:/bin", place.path().display());
    place.shoal(arguments).env("PATH", path).output().unwrap()
}

const HAND: [&str; 2] = ["--demonstrations", "pendulum/hand-v0"];

#[test]
fn a_replay_begins_with_the_rows_of_a_dataset() {
    let place = Workplace::new();
    python(&place, &demonstrated());
    let short = [
        "--steps",
        "200",
        "--set",
        "evaluation.final_episodes=2",
        "--set",
        "replay.warmup=64",
        "--json",
    ];
    let mut weights = Vec::new();
    for (run, more) in [("new", &["--lockstep"][..]), ("again", &["--lockstep"]), ("free", &[])] {
        let arguments = [&["train", "pendulum", "--run", run], &HAND[..], &short, more].concat();
        let output = with_python(&place, &arguments);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}");
        let begins = format!("{run} begins with 100 rows of the dataset pendulum/hand-v0 (5 episodes)");
        let log = std::fs::read_to_string(place.path().join(run).join("shoal.log")).unwrap();
        assert!(said.contains(&begins) && log.contains(&begins), "{said}");
        let result = json(&output);
        assert_eq!((&result["env_steps"], &result["updates"]), (&300.into(), &200.into()));
        weights.push(result["weights_sha256"].clone());
    }
    assert_eq!(
        weights[0], weights[1],
        "in lockstep the same beginning has the same end"
    );
    let run = place.path().join("new");
    let origin: Value = serde_json::from_str(&std::fs::read_to_string(run.join("origin.json")).unwrap()).unwrap();
    let expected = serde_json::json!({"format": 1, "dataset": "pendulum/hand-v0", "episodes": 5, "rows": 100});
    assert_eq!(origin, expected);
    let config = config(&run);
    assert_eq!(config.run.demonstrations.as_deref(), Some("pendulum/hand-v0"));

    // They are the first rows, with the discount of an actor's.
    let expected: Vec<u8> = demonstrated()
        .into_iter()
        .flat_map(|mut row| {
            row[5] = if row[5] == 1.0 { 0.0 } else { 0.99 };
            row.map(f32::to_le_bytes).concat()
        })
        .collect();
    let bytes = std::fs::read(run.join("replay.bin")).unwrap();
    let ring = shoal_learner::process::replay_layout(&config).ring as usize * 4 * config.row_layout().width();
    assert!(bytes[bytes.len() - ring.next_multiple_of(4096)..].starts_with(&expected));

    let resume = ["resume", "new", "--steps", "400", "--json"];
    assert_eq!(json(&place.output(&resume))["updates"], 300);
    assert!(place.output(&["report", "new", "--out", "page.html"]).status.success());
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert!(page.contains("begins with 100 rows of the dataset pendulum/hand-v0"));

    // As after a kill while the first files were written.
    std::fs::remove_file(run.join("origin.json")).unwrap();
    let message = error_line(&place.output(&["resume", "new", "--steps", "500"]));
    assert!(message.contains("new was interrupted while it copied"), "{message}");
}

#[test]
fn each_run_of_a_suite_begins_with_the_dataset() {
    let place = Workplace::new();
    python(&place, &demonstrated());
    let short = [
        "--steps",
        "100",
        "--set",
        "evaluation.final_episodes=1",
        "--seeds",
        "1..2",
        "--quiet",
    ];
    let output = with_python(
        &place,
        &[&["train", "pendulum", "--run", "suite"], &HAND[..], &short].concat(),
    );
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let origins = std::fs::read_dir(place.path().join("suite")).unwrap();
    let origins = origins.filter(|entry| entry.as_ref().unwrap().path().join("origin.json").exists());
    assert_eq!(origins.count(), 2);
}

#[test]
fn a_dataset_that_does_not_fit_is_refused_and_leaves_no_run() {
    let place = Workplace::new();
    python(&place, &demonstrated());
    let refused = |arguments: &[&str]| {
        let output = with_python(&place, &[&["train"], arguments, &["--run", "new"]].concat());
        let message = error_line(&output);
        assert!(!place.path().join("new").exists(), "{message}");
        (message, output.status.code())
    };
    for (arguments, part, code) in [
        (&["frozen-lake"][..], "q-learning learns from each step once", 2),
        (&["cart-pole"], "reinforce learns from each step once", 2),
        (
            &["pendulum", "--set", "replay.n_step=3"],
            "replay.n_step = 3: the rows of a dataset have one step",
            2,
        ),
        (&["point-mass-r1"], "the space of its observations is Box", 2),
        (
            &["pendulum", "--set", "replay.capacity=99", "--set", "replay.warmup=64"],
            "it has 100 rows, and replay.capacity = 99",
            2,
        ),
        (
            &["pendulum", "--set", "run.demonstrations=x"],
            "run.demonstrations cannot be set",
            2,
        ),
    ] {
        let (message, found) = refused(&[arguments, &HAND].concat());
        assert!(
            message.contains(part) && found == Some(code),
            "{arguments:?}: {message}"
        );
    }
    let (message, code) = refused(&["pendulum", "--demonstrations", "pendulum/none-v0"]);
    assert_eq!(
        (message.trim_end(), code),
        ("error: --demonstrations pendulum/none-v0: there is none", Some(1))
    );

    let mut rows = demonstrated();
    rows[7][3] = 2.5;
    python(&place, &rows);
    let (message, _) = refused(&[&["pendulum"], &HAND[..]].concat());
    assert!(
        message.contains("in its row 7, number 0 of the action is 2.5"),
        "{message}"
    );
    std::fs::write(place.path().join("rows"), "something else").unwrap();
    let (message, _) = refused(&[&["pendulum"], &HAND[..]].concat());
    assert!(
        message.contains("python3 has an incompatible version of the package shoal"),
        "{message}"
    );
    std::fs::write(place.path().join("bin/python3"), "#!/bin/sh\nexit 1\n").unwrap();
    let (message, _) = refused(&[&["pendulum"], &HAND[..]].concat());
    assert!(message.contains("python3 has no package shoal"), "{message}");
    let mut without_python = place.shoal(&[&["train", "pendulum", "--run", "new"], &HAND[..]].concat());
    let message = error_line(&without_python.env("PATH", place.path()).output().unwrap());
    assert!(message.contains("cannot start python3: install Python"), "{message}");
}
