//! Compares the program with data recorded from Gymnasium and PyTorch: every file in `tests/golden`, or in the
//! directory that `SHOAL_GOLDEN_DIR` names.

mod updates;
#[path = "../support/value_iteration.rs"]
mod value_iteration;

use std::path::{Path, PathBuf};

use serde_json::Value;
use shoal_common::stream::{Purpose, stream};
use shoal_env_server::environment::{
    Environment,
    cart_pole::{self, CartPole},
    frozen_lake,
    pendulum::{self, Pendulum},
};

/// The largest difference allowed from a recorded number.
const TOLERANCE: f64 = 1e-5;

/// Why a file disagrees.
type Failure = String;

#[test]
fn golden_files_agree() {
    let directory = match std::env::var_os("SHOAL_GOLDEN_DIR") {
        Some(directory) => PathBuf::from(directory),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden"),
    };
    let failures = check_directory(&directory);
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

#[test]
fn golden_directory_must_hold_files() {
    let missing = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/no such directory");
    assert_eq!(check_directory(&missing).len(), 1);
    let empty = Path::new(env!("CARGO_TARGET_TMPDIR")).join("golden-empty");
    std::fs::create_dir_all(&empty).unwrap();
    assert_eq!(check_directory(&empty).len(), 1);
}

#[test]
fn golden_files_of_unknown_kind_or_wrong_content_fail() {
    for text in [
        "",
        "[]",
        "{}",
        r#"{"env": "tetris"}"#,
        r#"{"env": "pendulum"}"#,
        r#"{"weights": []}"#,
    ] {
        assert!(check_text(text).is_err(), "{text}");
    }
    let rollout = |reward: &str, observation: &str| {
        let observations = format!(r#""observations": [[{observation}]]"#);
        let rest = format!(r#""actions": [[0.0]], "rewards": [{reward}], "terminated": [false]"#);
        check_text(&format!(
            r#"{{"env": "pendulum", "initial_state": [0.0, 0.0], {observations}, {rest}}}"#
        ))
    };
    assert_eq!(rollout("0.0", "1.0, 0.0, 0.0"), Ok(()));
    assert!(rollout("0.1", "1.0, 0.0, 0.0").is_err(), "wrong reward");
    assert!(rollout("0.0", "1.0, 0.0, 0.1").is_err(), "wrong observation");
    assert!(rollout("0.0", "1.0, 0.0").is_err(), "short observation");
    assert!(rollout("0.0, 0.0", "1.0, 0.0, 0.0").is_err(), "more rewards than steps");
}

/// Returns one line for each file that disagrees, or one line if the directory holds no files.
fn check_directory(directory: &Path) -> Vec<Failure> {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    // The scripts that generate the data, and this test, are in the same directory.
    let is_source = |path: &PathBuf| {
        path.extension()
            .is_some_and(|extension| extension == "py" || extension == "rs")
    };
    let files: Vec<PathBuf> = entries
        .map(|entry| entry.path())
        .filter(|path| !is_source(path))
        .collect();
    if files.is_empty() {
        return vec![format!("{} holds no golden files", directory.display())];
    }
    let check = |path: PathBuf| {
        let text = std::fs::read_to_string(&path).map_err(|e| e.to_string());
        let failure = text.and_then(|text| check_text(&text)).err()?;
        Some(format!("{}: {failure}", path.display()))
    };
    files.into_iter().filter_map(check).collect()
}

/// Determines the kind of a file from its content and checks it.
fn check_text(text: &str) -> Result<(), Failure> {
    let file: Value = serde_json::from_str(text).map_err(|e| e.to_string())?;
    match file.get("env").and_then(Value::as_str) {
        Some("pendulum") => {
            let pendulum = Pendulum::new(pendulum::PendulumParameters::default()).map_err(|e| e.to_string())?;
            rollout(&Rollout::read(&file)?, pendulum, |pendulum| {
                Some(pendulum.state().to_vec())
            })
        }
        Some("cart_pole") => {
            let cart_pole = CartPole::new(cart_pole::CartPoleParameters::default()).map_err(|e| e.to_string())?;
            rollout(&Rollout::read(&file)?, cart_pole, |_| None)
        }
        Some("frozen_lake") => frozen_lake(&file),
        None if file.get("hidden").is_some() && file.get("batches").is_some() => updates::check(&file),
        kind => Err(format!("unknown kind of file: env is {kind:?}")),
    }
}

/// Reads the element `key` of a file with one of the readers below.
fn read<T>(file: &Value, key: &str, reader: fn(Value) -> serde_json::Result<T>) -> Result<T, Failure> {
    reader(file[key].clone()).map_err(|e| format!("{key}: {e}"))
}

const NUMBERS: fn(Value) -> serde_json::Result<Vec<f64>> = serde_json::from_value;
const ROWS: fn(Value) -> serde_json::Result<Vec<Vec<f64>>> = serde_json::from_value;
const VALUES: fn(Value) -> serde_json::Result<Vec<Value>> = serde_json::from_value;
const FLAGS: fn(Value) -> serde_json::Result<Vec<bool>> = serde_json::from_value;

/// An episode recorded from Gymnasium; element i of each list belongs to step i.
struct Rollout {
    initial_state: Vec<f64>,
    actions: Vec<Vec<f64>>,
    observations: Vec<Vec<f64>>,
    rewards: Vec<f64>,
    terminated: Vec<bool>,
    states: Option<Vec<Vec<f64>>>,
}

impl Rollout {
    fn read(file: &Value) -> Result<Self, Failure> {
        Ok(Self {
            initial_state: read(file, "initial_state", NUMBERS)?,
            actions: read(file, "actions", ROWS)?,
            observations: read(file, "observations", ROWS)?,
            rewards: read(file, "rewards", NUMBERS)?,
            terminated: read(file, "terminated", FLAGS)?,
            states: file.get("states").map(|_| read(file, "states", ROWS)).transpose()?,
        })
    }
}

fn rollout<E: Environment>(
    recorded: &Rollout,
    mut environment: E,
    state: impl Fn(&E) -> Option<Vec<f64>>,
) -> Result<(), Failure> {
    let Rollout {
        initial_state,
        actions,
        observations,
        rewards,
        terminated,
        states,
    } = recorded;
    let steps = actions.len();
    let lengths = [
        observations.len(),
        rewards.len(),
        terminated.len(),
        states.as_ref().map_or(steps, Vec::len),
    ];
    if steps == 0 || lengths != [steps; 4] {
        return Err(format!("{steps} actions, but the other lists have lengths {lengths:?}"));
    }
    let spec = environment.spec();
    let mut rng = stream(0, Purpose::Environment, 0, 0);
    let mut observation = vec![0.0; spec.observation.width()];
    environment.reset_to(initial_state).map_err(|e| e.to_string())?;
    for (i, action) in actions.iter().enumerate() {
        if action.len() != spec.action.width() {
            return Err(format!("step {i}: an action of {} numbers", action.len()));
        }
        let step = environment.step(action, &mut rng);
        environment.observe(&mut observation);
        let observed: Vec<f64> = observation.iter().map(|x| f64::from(*x)).collect();
        close(&observed, &observations[i]).map_err(|e| format!("step {i}: observation {e}"))?;
        close(&[step.reward], &rewards[i..=i]).map_err(|e| format!("step {i}: reward {e}"))?;
        if step.terminated != terminated[i] {
            return Err(format!(
                "step {i}: terminated {}, recorded {}",
                step.terminated, terminated[i]
            ));
        }
        if let (Some(states), Some(state)) = (states, state(&environment)) {
            close(&state, &states[i]).map_err(|e| format!("step {i}: state {e}"))?;
        }
    }
    Ok(())
}

/// Checks that all numbers agree within `TOLERANCE`. A NaN agrees with nothing.
fn close(ours: &[f64], recorded: &[f64]) -> Result<(), Failure> {
    let agree = ours.len() == recorded.len() && ours.iter().zip(recorded).all(|(a, b)| (a - b).abs() <= TOLERANCE);
    if agree {
        Ok(())
    } else {
        Err(format!("{ours:?}, recorded {recorded:?}"))
    }
}

/// Compares Gymnasium's transition table, `transitions[state][action]`, and the optimal action values at γ = 0.999.
fn frozen_lake(file: &Value) -> Result<(), Failure> {
    type Table = Vec<Vec<Vec<Value>>>;
    let recorded = read(file, "transitions", serde_json::from_value::<Table>)?;
    let shape: Vec<_> = recorded.iter().map(Vec::len).collect();
    if shape != [frozen_lake::ACTIONS; frozen_lake::STATES] {
        return Err(format!("transitions for {shape:?} actions"));
    }
    for (state, actions) in recorded.iter().enumerate() {
        for (action, recorded) in actions.iter().enumerate() {
            let ours: Vec<_> = frozen_lake::transitions(state, action).collect();
            if ours.len() != recorded.len() || !ours.iter().zip(recorded).all(|(a, b)| same_outcome(a, b)) {
                return Err(format!(
                    "action {action} in state {state}: {ours:?}, recorded {recorded:?}"
                ));
            }
        }
    }
    let recorded = read(file, "q_star_gamma_0_999", ROWS)?;
    let q_star = value_iteration::optimal_values(0.999);
    if recorded.len() != q_star.len() {
        return Err(format!("action values for {} states", recorded.len()));
    }
    for (state, (ours, recorded)) in q_star.iter().zip(&recorded).enumerate() {
        close(ours, recorded).map_err(|e| format!("action values of state {state}: {e}"))?;
    }
    Ok(())
}

fn same_outcome(ours: &frozen_lake::LakeTransition, recorded: &Value) -> bool {
    recorded["p"].as_f64().is_some_and(|p| (p - ours.p).abs() <= 1e-9)
        && recorded["next"].as_u64() == Some(ours.next as u64)
        && recorded["reward"].as_f64() == Some(ours.reward)
        && recorded["terminated"].as_bool() == Some(ours.terminated)
}
