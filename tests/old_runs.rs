//! Runs that earlier versions left behind are read, and gone on with. `tests/data/README.md` says what they are.
//!
//! An unpacked run has the id it was made with, so two copies of it must not go on at once: each archive has one test.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]
#![allow(clippy::print_stderr, reason = "a test says what it reads")]

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
        test!(a_free_run_that_is_finished_is_read_and_given_more_steps),
        test!(a_free_run_that_was_stopped_is_read_and_goes_on_to_its_end),
        test!(a_lockstep_run_that_is_finished_is_read_and_given_more_steps),
        test!(a_lockstep_run_that_was_stopped_is_read_and_goes_on_to_its_end),
        test!(a_gymnasium_run_that_is_finished_is_read_and_given_more_steps),
        test!(a_gymnasium_run_that_was_stopped_is_read_and_goes_on_to_its_end),
    ])
}

/// The versions whose runs are kept, as their directories in `tests/data/` are named.
const VERSIONS: [&str; 1] = ["2d50610"];

/// How the kept run ended.
#[derive(Clone, Copy, PartialEq)]
enum Ended {
    Finished,
    Stopped,
}

fn a_free_run_that_is_finished_is_read_and_given_more_steps() {
    every_version_of("free-finished", Ended::Finished);
}

fn a_free_run_that_was_stopped_is_read_and_goes_on_to_its_end() {
    every_version_of("free-stopped", Ended::Stopped);
}

fn a_lockstep_run_that_is_finished_is_read_and_given_more_steps() {
    every_version_of("lockstep-finished", Ended::Finished);
}

fn a_lockstep_run_that_was_stopped_is_read_and_goes_on_to_its_end() {
    every_version_of("lockstep-stopped", Ended::Stopped);
}

fn a_gymnasium_run_that_is_finished_is_read_and_given_more_steps() -> Completion {
    every_version_of_gymnasiums("gym-finished", Ended::Finished)
}

fn a_gymnasium_run_that_was_stopped_is_read_and_goes_on_to_its_end() -> Completion {
    every_version_of_gymnasiums("gym-stopped", Ended::Stopped)
}

/// A run whose environments Python serves is only read where there are none.
fn every_version_of_gymnasiums(name: &str, ended: Ended) -> Completion {
    let missing = PYTHON.missing();
    is_good(name, ended, missing.is_none());
    match missing {
        None => Completion::Completed,
        Some(missing) => Completion::ignored_with(format!("read, and neither played nor gone on with: {missing}")),
    }
}

fn every_version_of(name: &str, ended: Ended) {
    is_good(name, ended, true);
}

/// What is not playable is only read.
fn is_good(name: &str, ended: Ended, playable: bool) {
    for version in VERSIONS {
        eprintln!("{version}/{name}");
        let place = unpacked(version, name);
        let state = match ended {
            Ended::Finished => "finished",
            Ended::Stopped => "stopped",
        };
        is_the_run_that_its_replay_is_of(&place);
        is_listed_as(&place, state);
        is_read(&place, playable);
        if playable {
            goes_on(&place, ended);
            // Now its records have rows of both versions.
            is_listed_as(&place, "finished");
            is_read(&place, playable);
        }
    }
}

/// A place in which the archive's run lies as `run`.
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

/// The configuration has the fingerprint that stands in the header of the replay (`ARCHITECTURE.md`, "The replay file").
fn is_the_run_that_its_replay_is_of(place: &Workplace) {
    const FINGERPRINT: usize = 8;
    let header = std::fs::read(place.path().join("run/replay.bin")).unwrap();
    let word = header[FINGERPRINT * 8..][..8].try_into().unwrap();
    let config = Config::load(&place.path().join("run/config.toml")).unwrap();
    assert_eq!(config.fingerprint(), u64::from_le_bytes(word), "{}", config.identity());
}

/// What a command that must succeed printed.
fn printed(place: &Workplace, arguments: &[&str]) -> String {
    let output = place.output(arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {said}");
    String::from_utf8(output.stdout).unwrap()
}

/// `shoal list` says that the run is in this state.
fn is_listed_as(place: &Workplace, state: &str) {
    let listed: Value = serde_json::from_str(&printed(place, &["list", ".", "--json"])).unwrap();
    assert_eq!(listed["runs"][0]["state"], state, "{listed}");
}

/// The run's policies, records and settings are read by all commands that do. What plays episodes of an environment that
/// cannot be served here is left out.
fn is_read(place: &Workplace, playable: bool) {
    if playable {
        is_evaluated_as_before(place);
    }

    let figures = printed(place, &["plot", "run", "--out", "figures"]);
    assert!(figures.contains("learning-curve.svg"), "{figures}");
    for figure in figures.lines() {
        let figure = std::fs::read_to_string(place.path().join(figure)).unwrap();
        assert!(figure.contains("<polyline"), "something is drawn");
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
            let arguments = ["export", "run", "--policy", policy, "--out", "policy", "--format", form];
            printed(place, &arguments);
            std::fs::read(place.path().join("policy")).unwrap()
        };
        Model::load(export("onnx")).unwrap();
        assert!(!SafeTensors::deserialize(&export("safetensors")).unwrap().is_empty());
    }
}

/// The best policy does what the run's evaluator wrote down. Another processor may round otherwise.
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

/// Goes on to the end the run was to have, or to a later one, with all that was learned and collected before.
fn goes_on(place: &Workplace, ended: Ended) {
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
    let log = std::fs::read_to_string(run.join("shoal.log")).unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(0), "{said}\n{log}");
    let result = json(&output);
    assert_eq!(result["env_steps"], steps);
    assert!(result["eval_return_mean"].is_f64(), "{result}");
    let updates = number("updates");
    assert!(result["updates"].as_u64().unwrap() > updates, "{result}");
    let going_on = format!("going on after {updates} updates and ");
    let going_on = log
        .lines()
        .find(|line| line.contains(&going_on))
        .unwrap_or_else(|| panic!("{log}"));
    assert!(going_on.ends_with(&format!("of {rows} rows")), "{going_on}");
    assert!(!log.contains("is damaged"), "{log}");
    let left = Leftovers::of(&run);
    assert!(left.processes().is_empty() && left.files().is_empty());
}
