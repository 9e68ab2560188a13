//! Reads and resumes runs of earlier versions. `tests/data/README.md` describes them.
//!
//! An unpacked run keeps its id, so two copies of it must not run at the same time: each archive has one test.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]
#![allow(clippy::print_stderr, reason = "a test prints what it reads")]

#[path = "support/suite.rs"]
mod suite;
mod support;

use std::path::Path;
use std::process::{Command, ExitCode};

use libtest_mimic::Completion;
use rten::Model;
use safetensors::SafeTensors;
use serde_json::Value;
use shoal_common::config::Config;
use suite::{PYTHON, test};
use support::{Leftovers, Workplace, json};

fn main() -> ExitCode {
    suite::run(vec![
        test!(a_finished_free_run_is_read_and_extended),
        test!(a_stopped_free_run_is_read_and_resumed_to_its_end),
        test!(a_finished_lockstep_run_is_read_and_extended),
        test!(a_stopped_lockstep_run_is_read_and_resumed_to_its_end),
        test!(a_finished_gymnasium_run_is_read_and_extended),
        test!(a_stopped_gymnasium_run_is_read_and_resumed_to_its_end),
    ])
}

/// The versions whose runs are kept, by the names of their directories in `tests/data/`.
const VERSIONS: [&str; 1] = ["2d50610"];

/// How an archived run ended.
#[derive(Clone, Copy, PartialEq)]
enum Ended {
    Finished,
    Stopped,
}

fn a_finished_free_run_is_read_and_extended() {
    check_versions("free-finished", Ended::Finished);
}

fn a_stopped_free_run_is_read_and_resumed_to_its_end() {
    check_versions("free-stopped", Ended::Stopped);
}

fn a_finished_lockstep_run_is_read_and_extended() {
    check_versions("lockstep-finished", Ended::Finished);
}

fn a_stopped_lockstep_run_is_read_and_resumed_to_its_end() {
    check_versions("lockstep-stopped", Ended::Stopped);
}

fn a_finished_gymnasium_run_is_read_and_extended() -> Completion {
    check_versions_with_gymnasium("gym-finished", Ended::Finished)
}

fn a_stopped_gymnasium_run_is_read_and_resumed_to_its_end() -> Completion {
    check_versions_with_gymnasium("gym-stopped", Ended::Stopped)
}

/// Python serves the environments of these runs. Without it they are only read.
fn check_versions_with_gymnasium(name: &str, ended: Ended) -> Completion {
    let missing = PYTHON.missing();
    check(name, ended, missing.is_none());
    match missing {
        None => Completion::Completed,
        Some(missing) => Completion::ignored_with(format!("read, but neither played nor resumed: {missing}")),
    }
}

fn check_versions(name: &str, ended: Ended) {
    check(name, ended, true);
}

/// Reads the run of every version. If its environment is available (`playable`), also resumes it and reads it again.
fn check(name: &str, ended: Ended, playable: bool) {
    for version in VERSIONS {
        eprintln!("{version}/{name}");
        let place = unpacked(version, name);
        let state = match ended {
            Ended::Finished => "finished",
            Ended::Stopped => "stopped",
        };
        has_the_fingerprint_of_its_replay(&place);
        is_listed_as(&place, state);
        is_read(&place, playable);
        if playable {
            is_resumed(&place, ended);
            if name == "gym-stopped" {
                its_best_policy_is_not_evaluated_anew_again(&place);
            }
            // Now its records have rows of both versions.
            is_listed_as(&place, "finished");
            is_read(&place, playable);
        }
    }
}

/// A workplace with the archive's run unpacked as `run`.
fn unpacked(version: &str, name: &str) -> Workplace {
    let place = Workplace::new();
    let archive = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("tests/data/{version}/{name}.tar.gz"));
    let status = Command::new("tar")
        .args(["--extract", "--gzip", "--no-same-owner", "--file"])
        .arg(&archive)
        .current_dir(place.path())
        .status();
    assert!(status.unwrap().success(), "{}", archive.display());
    std::fs::rename(place.path().join(name), place.path().join("run")).unwrap();
    place
}

/// The configuration has the fingerprint in the replay's header (`docs/REPLAY_FORMAT.md`).
fn has_the_fingerprint_of_its_replay(place: &Workplace) {
    const FINGERPRINT: usize = 8;
    let header = std::fs::read(place.path().join("run/replay.bin")).unwrap();
    let word = header[FINGERPRINT * 8..][..8].try_into().unwrap();
    let config = Config::load(&place.path().join("run/config.toml")).unwrap();
    assert_eq!(config.fingerprint(), u64::from_le_bytes(word), "{}", config.identity());
}

/// Standard output of a command, which must succeed.
fn printed(place: &Workplace, arguments: &[&str]) -> String {
    let output = place.output(arguments);
    let message = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {message}");
    String::from_utf8(output.stdout).unwrap()
}

/// `shoal list` reports the run in this state.
fn is_listed_as(place: &Workplace, state: &str) {
    let listed: Value = serde_json::from_str(&printed(place, &["list", ".", "--json"])).unwrap();
    assert_eq!(listed["runs"][0]["state"], state, "{listed}");
}

/// Every command that reads a run's policies, records or settings succeeds. Episodes are played only if the environment
/// is available.
fn is_read(place: &Workplace, playable: bool) {
    if playable {
        is_evaluated_as_before(place);
    }

    let figures = printed(place, &["plot", "run", "--out", "figures"]);
    assert!(figures.contains("learning-curve.svg"), "{figures}");
    for figure in figures.lines() {
        let figure = std::fs::read_to_string(place.path().join(figure)).unwrap();
        assert!(figure.contains("<polyline"), "the figure has a curve");
    }

    printed(place, &["report", "run", "--out", "page.html"]);
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    let shown = page.split_once("id=\"data\">").unwrap().1;
    let shown: Value = serde_json::from_str(shown.split_once("</script>").unwrap().0).unwrap();
    let shown = &shown["runs"][0];
    let rows = |what: &str| shown[what]["rows"].as_u64().unwrap();
    assert!(rows("evaluations") > 0 && rows("exploration") > 0, "{shown}");
    let played = shown["played"]["episodes"].as_array();
    assert_eq!(played.is_some_and(|episodes| !episodes.is_empty()), playable, "{shown}");

    for policy in ["best", "last"] {
        let export = |form| {
            let out = format!("policy.{form}");
            printed(
                place,
                &["export", "run", "--policy", policy, "--out", &out, "--format", form],
            );
            std::fs::read(place.path().join(&out)).unwrap()
        };
        Model::load(export("onnx")).unwrap();
        assert!(!SafeTensors::deserialize(&export("safetensors")).unwrap().is_empty());
    }
}

/// The best policy has the return that the run's evaluator recorded. Another processor may round differently.
fn is_evaluated_as_before(place: &Workplace) {
    let mut records = csv::Reader::from_path(place.path().join("run/evaluations.csv")).unwrap();
    let columns = records.headers().unwrap().clone();
    let column = |name| columns.iter().position(|column| column == name).unwrap();
    let [best, episodes, mean] = ["best", "episodes", "return_mean"].map(column);
    let evaluated = records
        .records()
        .map(Result::unwrap)
        .filter(|row| &row[best] == "1")
        .last();
    let evaluated = evaluated.unwrap();

    let (mut episodes, mut then) = (evaluated[episodes].to_owned(), evaluated[mean].parse::<f64>().unwrap());
    // The final evaluation may have made the last policy the best one.
    if let Ok(text) = std::fs::read_to_string(place.path().join("run/final-evaluation.json")) {
        let found: Value = serde_json::from_str(&text).unwrap();
        let kept = found["policies"].as_array().unwrap().iter();
        let kept = kept.clone().find(|it| it["policy"] == found["kept"]).unwrap();
        (episodes, then) = (kept["episodes"].to_string(), kept["return_mean"].as_f64().unwrap());
    }

    let evaluate = ["eval", "run", "--json", "--episodes", &episodes];
    let now: Value = serde_json::from_str(&printed(place, &evaluate)).unwrap();
    let now = now["return_mean"].as_f64().unwrap();
    assert!((now - then).abs() <= 1e-3 * then.abs().max(1.0), "{now} and {then}");
}

fn its_best_policy_is_not_evaluated_anew_again(place: &Workplace) {
    let steps = json(&place.output(&["status", "run", "--json"]))["steps"]
        .as_u64()
        .unwrap();
    let output = place.output(&["resume", "run", "--json", "--steps", &(steps + 500).to_string()]);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success() && !said.contains("re-evaluated"), "{said}");
}

/// Resumes a stopped run to its planned end, or a finished one to a later end. It keeps what it learned and collected.
fn is_resumed(place: &Workplace, ended: Ended) {
    let before = support::json(&place.output(&["status", "run", "--json"]));
    let number = |field: &str| before[field].as_u64().unwrap();
    let rows = number("replay_rows");
    let mut resume = vec!["resume", "run", "--json"];
    let mut steps = number("steps");
    let more;
    if ended == Ended::Finished {
        steps += 1000;
        more = steps.to_string();
        resume.extend(["--steps", &more]);
    }
    assert!(0 < rows && rows < steps, "{before}");

    let output = place.output(&resume);
    let run = place.path().join("run");
    // Earlier versions evaluated in Gymnasium's environments from other starts.
    let config = Config::load(&run.join("config.toml")).unwrap();
    let is_served = config.environment.name.starts_with("gym:");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(said.contains("the best policy is re-evaluated"), is_served, "{said}");
    assert_eq!(run.join("server.json").exists(), is_served);
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    let message = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{message}\n{log}");
    let result = json(&output);
    assert_eq!(result["env_steps"], steps);
    assert!(result["eval_return_mean"].is_f64(), "{result}");
    let updates = number("updates");
    assert!(result["updates"].as_u64().unwrap() > updates, "{result}");
    let resumed = format!("continuing after {updates} updates and ");
    let resumed = log
        .lines()
        .find(|line| line.contains(&resumed))
        .unwrap_or_else(|| panic!("{log}"));
    assert!(resumed.ends_with(&format!("of {rows} rows")), "{resumed}");
    assert!(!log.contains("is damaged"), "{log}");
    let left = Leftovers::of(&run);
    assert!(left.processes().is_empty() && left.files().is_empty());
}
