//! What the tests share: the environments of `shoal_test_environments.py`, and runs with them.

use std::path::Path;

use shoal_common::config::Config;
use shoal_learner::replay::ReplayLayout;

use crate::support::Workplace;

/// Prefix of the environments of `shoal_test_environments.py`.
pub(crate) const OURS: &str = "gym:shoal_test_environments:";

/// A directory in which `python3` finds the environments of the tests.
pub(crate) fn place() -> Workplace {
    let place = Workplace::new();
    let module = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/gym/shoal_test_environments.py");
    // Python finds modules in its working directory.
    std::fs::copy(module, place.path().join("shoal_test_environments.py")).unwrap();
    place
}

pub(crate) const SHORT: [&str; 4] = ["--set", "evaluation.every=1000", "--envs", "2"];

pub(crate) fn config(place: &Workplace) -> Config {
    Config::load(&place.path().join("run/config.toml")).unwrap()
}

pub(crate) fn layout_of(place: &Workplace, run: &str) -> ReplayLayout {
    let config = Config::load(&place.path().join(run).join("config.toml")).unwrap();
    shoal_learner::process::replay_layout(&config)
}

/// `environment.server` as a function of `shoal_test_environments.py`, which is called with this Python expression.
pub(crate) fn server_of(function: &str, argument: &str) -> String {
    let program = format!("from shoal_test_environments import {function}; raise SystemExit({function}({argument}))");
    let program = serde_json::to_string(&["python3", "-c", &program]).unwrap();
    format!("environment.server={program}")
}

/// Processes with `words` in their command line and the test's directory as working directory.
pub(crate) fn processes_of(place: &Workplace, words: &str) -> Vec<i32> {
    let here = place.path().canonicalize().unwrap();
    let listed = std::fs::read_dir("/proc").unwrap().flatten();
    let pids = listed.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    pids.filter(|pid| {
        let command = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let command = String::from_utf8_lossy(&command).replace('\0', " ");
        let directory = std::fs::read_link(format!("/proc/{pid}/cwd")).unwrap_or_default();
        command.contains(words) && directory == here
    })
    .collect()
}
