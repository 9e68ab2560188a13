//! `import shoal`: runs that Python starts, and numpy policies beside this program's policies.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

#[path = "../support/suite.rs"]
mod suite;
#[path = "../support/mod.rs"]
mod support;

use std::collections::BTreeMap;
use std::process::{Command, ExitCode};
use std::time::{Duration, Instant};

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};
use rustix::process::Signal;
use shoal_common::policy::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;
use shoal_common::space::Space;
use suite::{Need, PYTHON, test};
use support::{Workplace, error_line, until};

static MATPLOTLIB: Need = Need::new("python3 has no matplotlib", || python_has("matplotlib"), None);

static MLFLOW: Need = Need::new("python3 has no mlflow", || python_has("mlflow"), None);
static MINARI: Need = Need::new(
    "python3 has no minari, h5py and pillow",
    || python_has("minari, h5py, PIL"),
    None,
);
static WANDB: Need = Need::new("python3 has no wandb", || python_has("wandb"), None);

fn main() -> ExitCode {
    suite::run(vec![
        test!(numpy_policies_act_as_those_of_the_program, PYTHON),
        test!(runs_are_started_read_changed_and_stopped_from_python, PYTHON),
        test!(a_training_ends_with_the_python_that_waits_for_it, PYTHON),
        test!(suites_are_trained_and_read_from_python, PYTHON),
        test!(the_tutorials_python_works, PYTHON),
        test!(the_notebook_works, PYTHON, MATPLOTLIB),
        test!(a_run_is_tracked_while_it_runs, PYTHON, MLFLOW, WANDB),
        test!(replays_become_datasets_and_begin_with_them, PYTHON, MINARI),
        test!(what_is_missing_for_datasets_is_named, PYTHON),
    ])
}

fn python_has(module: &str) -> bool {
    let output = Command::new("python3")
        .args(["-c", &format!("import {module}")])
        .output();
    output.is_ok_and(|output| output.status.success())
}

/// Runs `python3` with these arguments in the workplace, to its end, and returns what it printed.
fn python(place: &Workplace, arguments: &[&str]) -> String {
    let output = Command::new("timeout")
        .args(["400", "python3"])
        .args(arguments)
        .env("SHOAL", env!("CARGO_BIN_EXE_shoal"))
        .env("MPLBACKEND", "agg")
        .current_dir(place.path())
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// The path of a script of this folder.
fn script(name: &str) -> String {
    format!("{}/tests/python/{name}", env!("CARGO_MANIFEST_DIR"))
}

/// Observations of this space, also some beyond it.
fn observations(space: &Space, count: usize) -> Vec<Vec<f32>> {
    let mut random = StdRng::seed_from_u64(1);
    let mut number = |low: f32, high: f32| {
        let (low, high) = (low.max(-3.0), high.min(3.0));
        low + (high - low) * random.random_range(-0.2..1.2)
    };
    let mut one = || match space {
        Space::Box { low, high } => low.iter().zip(high).map(|(low, high)| number(*low, *high)).collect(),
        Space::Discrete { n, .. } => vec![number(0.0, *n as f32).floor().max(0.0)],
    };
    (0..count).map(|_| one()).collect()
}

fn numpy_policies_act_as_those_of_the_program() {
    let place = Workplace::new();
    let normalised = "observation.normalise=true";
    let td3: &[&str] = &["--set", "td3.hidden=[24, 16]", "--set", normalised];
    let sac: &[&str] = &["--set", "sac.hidden=[24, 16]", "--set", "sac.activation=tanh"];
    let dqn: &[&str] = &["--method", "dqn", "--set", "dqn.hidden=[24]", "--set", normalised];
    let dueling: &[&str] = &["--method", "dqn", "--set", "dqn.dueling=true"];
    for (name, task, options) in [
        ("ddpg", "pendulum", &["--set", "ddpg.hidden=[24, 16]"][..]),
        ("td3", "pendulum-td3", td3),
        ("sac", "pendulum-sac", sac),
        ("reinforce", "cart-pole", &[]),
        ("dqn", "cart-pole", dqn),
        ("dueling", "cart-pole", dueling),
        ("q-learning", "frozen-lake", &[]),
        ("sarsa", "frozen-lake-sarsa", &[]),
    ] {
        let quick = ["--steps", "600", "--quiet", "--set", "evaluation.final_episodes=3"];
        let arguments = [&["train", task, "--run", name], &quick[..], options].concat();
        let output = place.output(&arguments);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let path = place.path().join(name);
        let config = RunDir::open(&path).unwrap().config().unwrap();
        let observations = observations(&config.spec.observation, 200);
        let mut policy = config.policy(observations.len()).unwrap();
        let mut expected = BTreeMap::new();
        for which in ["best", "last"] {
            let file = path.join("checkpoints").join(format!("{which}.policy"));
            let parameters = PolicyFile::read(&file, &policy.layout()).unwrap().parameters;
            let mut actions = vec![f32::NAN; observations.len() * config.spec.action.width()];
            policy.act(&parameters, &observations.concat(), &mut actions);
            let flat = matches!(config.spec.observation, Space::Discrete { .. });
            let observations = match flat {
                true => serde_json::json!(observations.concat()),
                false => serde_json::json!(observations),
            };
            expected.insert(which, (observations, actions));
        }
        std::fs::write(
            place.path().join("expected.json"),
            serde_json::to_string(&expected).unwrap(),
        )
        .unwrap();
        python(&place, &[&script("policies.py"), name]);
    }
}

fn runs_are_started_read_changed_and_stopped_from_python() {
    python(&Workplace::new(), &[&script("every_day.py")]);
}

fn a_training_ends_with_the_python_that_waits_for_it() {
    let place = Workplace::new();
    let code = "import shoal; shoal.train('pendulum', run='run', steps=100_000_000, set={'ddpg.hidden': [16, 16]})";
    let mut python = Command::new("python3");
    python
        .args(["-c", code])
        .env("SHOAL", env!("CARGO_BIN_EXE_shoal"))
        .current_dir(place.path());
    let running = place.launch_command("run", &mut python);
    let run = RunDir::open(&running.run).unwrap();
    running.wait_for_learning();
    let leftovers = running.leftovers();
    running.signal(Signal::KILL);
    running.wait_for_launcher();
    let begun = Instant::now();
    while run.is_running().unwrap() && begun.elapsed() < Duration::from_secs(60) {
        std::thread::sleep(Duration::from_millis(20));
    }
    if run.is_running().unwrap() {
        // So that this test leaves nothing.
        place.output(&["stop", "run"]);
        panic!("the run goes on without Python");
    }
    until("its roles have ended", || leftovers.processes().is_empty());
    let resumed = place.resume("run", &[]);
    resumed.wait_for_learning();
    assert!(place.output(&["stop", "run"]).status.success());
    assert_eq!(resumed.wait().0, Some(0));
}

fn suites_are_trained_and_read_from_python() {
    python(&Workplace::new(), &[&script("suites.py")]);
}

fn the_tutorials_python_works() {
    let tutorial = include_str!("../../docs/TUTORIAL.md");
    let blocks = tutorial.split("```python\n").skip(1);
    let code: String = blocks.map(|rest| rest.split_once("```").unwrap().0).collect();
    let printed = python(&Workplace::new(), &["-c", &code]);
    // A hanging pendulum gets -1,200 or less.
    let number = |after: &str| -> f64 {
        let line = printed.lines().find_map(|line| line.strip_prefix(after));
        line.unwrap_or_else(|| panic!("{printed}")).trim().parse().unwrap()
    };
    assert!(number("best mean return:") > -400.0, "{printed}");
    assert!(number("in Gymnasium:") > -700.0, "{printed}");
    assert!(printed.contains("30000 transitions"), "{printed}");
}

fn the_notebook_works() {
    let notebook: serde_json::Value =
        serde_json::from_str(include_str!("../../python/examples/pendulum.ipynb")).unwrap();
    let cells = notebook["cells"].as_array().unwrap().iter();
    let code = cells.filter(|cell| cell["cell_type"] == "code");
    let lines = code.flat_map(|cell| {
        cell["source"]
            .as_array()
            .unwrap()
            .iter()
            .chain([&serde_json::Value::Null])
    });
    let text: String = lines.map(|line| line.as_str().unwrap_or("\n")).collect();
    let checked = format!("{text}\nassert total > -700 and abs(torque).max() > 1.5, total");
    python(&Workplace::new(), &["-c", &checked]);
}

/// Minari's own loader reads what was written.
fn replays_become_datasets_and_begin_with_them() {
    python(&Workplace::new(), &[&script("demonstrations.py")]);
}

fn what_is_missing_for_datasets_is_named() {
    let place = Workplace::new();
    std::fs::create_dir(place.path().join("without")).unwrap();
    std::fs::write(place.path().join("without/minari.py"), "raise ImportError('none')\n").unwrap();
    let quick = ["--steps", "100", "--quiet", "--set", "evaluation.final_episodes=1"];
    for (run, set) in [
        ("plain", "replay.n_step=1"),
        ("several", "replay.n_step=3"),
        ("short", "ddpg.gamma=0"),
    ] {
        let arguments = [&["train", "pendulum", "--run", run, "--set", set], &quick[..]].concat();
        assert!(place.output(&arguments).status.success(), "{run}");
    }
    let refused = |arguments: &[&str]| {
        let mut command = place.shoal(arguments);
        command.env("PYTHONPATH", place.path().join("without"));
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(1), "{arguments:?}");
        error_line(&output)
    };
    for (run, part) in [
        ("plain", "pip install minari"),
        ("several", "replay.n_step = 3"),
        ("short", "ddpg.gamma = 0"),
    ] {
        let message = refused(&["export", run, "--minari", "pendulum/none-v0"]);
        assert!(message.contains(part), "{run}: {message}");
    }
    for wrong in [
        &["--format", "onnx", "--author", "me"][..],
        &["--minari", "x/y-v0", "--out", "file"],
        &[],
    ] {
        let output = place.output(&[&["export", "plain"], wrong].concat());
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
    }
    let message = refused(&[
        "train",
        "pendulum",
        "--run",
        "new",
        "--demonstrations",
        "pendulum/none-v0",
    ]);
    assert!(
        message.contains("--demonstrations pendulum/none-v0: ") && message.contains("pip install minari"),
        "{message}"
    );
    assert!(!place.path().join("new").exists());
}

/// The trackers' own programs read what was stored.
fn a_run_is_tracked_while_it_runs() {
    let place = Workplace::new();
    let running = place.start("run", &["--steps", "100000000", "--set", "evaluation.every=500"]);
    let track = |to: &str| {
        let mut command = place.shoal(&["track", "run", "--to", to]);
        let store = format!("file://{}/mlruns", place.path().display());
        command
            .env("MLFLOW_TRACKING_URI", store)
            .env("MLFLOW_ALLOW_FILE_STORE", "true");
        command.env("WANDB_MODE", "offline").env("WANDB_SILENT", "true");
        command.stderr(std::process::Stdio::piped()).spawn().unwrap()
    };
    let following = ["mlflow", "wandb"].map(track);
    until("both have begun", || {
        let begun = |to| place.path().join(format!("run/tracking-{to}.json")).exists();
        begun("mlflow") && begun("wandb")
    });
    running.wait_for_learning();
    assert!(place.output(&["stop", "run"]).status.success());
    running.wait();
    for follower in following {
        let output = follower.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    }
    python(&place, &[&script("tracked.py"), "run"]);
}
