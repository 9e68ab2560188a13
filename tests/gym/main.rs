//! Environments of Gymnasium, served from Python. Where `python3` lacks the package shoal-gym these tests say that they
//! were skipped; with `SHOAL_REQUIRE_PYTHON` set they fail.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]
#![allow(clippy::print_stderr, reason = "who skips a test says so")]

#[path = "../support/mod.rs"]
mod support;

use std::path::Path;

use rustix::process::Signal;
use shoal_common::config::Config;
use shoal_common::space::Space;
use support::{Workplace, complaint, end_of, parse, python_serves, until};

/// A module with environments for the tests.
const OURS: &str = "gym:shoal_test_environments:";

/// Where `python3` serves Gymnasium's environments, and finds those of the tests; `None` where it cannot.
fn place() -> Option<Workplace> {
    if !python_serves() {
        eprintln!("skipped: python3 has no shoal_gym");
        return None;
    }
    let place = Workplace::new();
    let module = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/gym/shoal_test_environments.py");
    // Python finds modules where it is started.
    std::fs::copy(module, place.path().join("shoal_test_environments.py")).unwrap();
    Some(place)
}

const SHORT: [&str; 4] = ["--set", "evaluation.every=1000", "--envs", "2"];

fn config(place: &Workplace) -> Config {
    Config::load(&place.path().join("run/config.toml")).unwrap()
}

#[test]
fn gymnasiums_pendulum_is_trained_while_its_servers_are_killed() {
    let Some(place) = place() else { return };
    let steps = ["--steps", "6000"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &steps].concat());
    for who in ["env-server-0", "env-server-16"] {
        running.learns_on();
        running.kill(who);
        until("it is replaced", || running.pids(who).len() == 2);
    }
    running.learns_on();
    let (code, printed, leftovers) = running.wait();
    assert_eq!(code, Some(0), "{}", place.said());
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
    assert_eq!(parse(&printed)["env_steps"], 6000);

    let spec = config(&place).spec;
    assert_eq!(spec.observation, Space::boxed(&[(-1.0, 1.0), (-1.0, 1.0), (-8.0, 8.0)]));
    assert_eq!(spec.action, Space::boxed(&[(-2.0, 2.0)]));
    assert_eq!((spec.time_limit, spec.state_width), (200, 0));

    let judged = || place.output(&["eval", "run", "--episodes", "3", "--json"]);
    let (first, second) = (judged(), judged());
    assert!(first.status.success(), "{}", String::from_utf8_lossy(&first.stderr));
    assert_eq!(first.stdout, second.stdout, "evaluation episodes start alike");
    let output = place.output(&["report", "run", "--out", "page.html"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let page = std::fs::read_to_string(place.path().join("page.html")).unwrap();
    assert!(page.contains("\"terminated\":false"), "episodes are played");
}

#[test]
fn seeds_reach_the_environments_and_lockstep_gives_the_same_bits() {
    let Some(place) = place() else { return };
    let environment = format!("{OURS}Ends-v0");
    let weights = |name: &str, seed: &str| {
        let arguments = ["--lockstep", "--steps", "400", "--seed", seed];
        end_of(place.start_in(name, &environment, &[&SHORT[..], &arguments].concat()))
    };
    let first = weights("run", "1");
    assert_eq!(weights("again", "1"), first);
    assert_ne!(weights("other", "2"), first);
    let spec = config(&place).spec;
    assert_eq!((spec.observation.width(), spec.action.width()), (4, 2), "flattened");
}

#[test]
fn what_ends_by_itself_and_what_the_limit_ends_are_kept_apart() {
    let Some(place) = place() else { return };
    for (after, steps, terminated) in [("3", "3", "1"), ("0", "5", "0"), ("5", "5", "1")] {
        let name = format!("after-{after}");
        let after = format!("environment.after={after}");
        let arguments = ["--steps", "300", "--set", &after];
        let running = place.start_in(&name, &format!("{OURS}Ends-v0"), &[&SHORT[..], &arguments].concat());
        let episodes = running.run.join("episodes.csv");
        assert_eq!(running.wait().0, Some(0), "{}", place.said());
        let mut episodes = csv::Reader::from_path(episodes).unwrap();
        let rows: Vec<_> = episodes.records().map(Result::unwrap).collect();
        assert!(rows.len() > 20);
        for row in rows {
            assert_eq!((&row[4], &row[5]), (steps, terminated), "{row:?}");
        }
    }
}

#[test]
fn discrete_spaces_are_counted_from_zero_and_learned_by_a_table() {
    let Some(place) = place() else { return };
    let arguments = ["--steps", "3000", "--set", "q-learning.epsilon=0.5"];
    let plain = ["train", &format!("{OURS}Offset-v0"), "--run", "run", "--json"];
    let output = place.output(&[&plain[..], &arguments].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let spec = config(&place).spec;
    assert_eq!(
        (spec.observation, spec.action),
        (Space::Discrete { n: 4 }, Space::Discrete { n: 3 })
    );
    assert_eq!(support::json(&output)["eval_return_mean"], 3.0, "it walks to the end");
}

#[test]
fn an_environment_that_fails_is_a_dead_role_whose_last_words_are_shown() {
    let Some(place) = place() else { return };
    for (how, word) in [("raise", "the motor is on fire"), ("abort", "killed by signal 6")] {
        let run = format!("run-{how}");
        let how = format!("environment.how={how}");
        let environment = format!("{OURS}Fails-v0");
        let output = place.output(&["train", &environment, "--run", &run, "--steps", "1000", "--set", &how]);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{said}");
        assert!(
            said.contains("env-server") && said.contains("failed 5 times") && said.contains(word),
            "{said}"
        );
    }
}

#[test]
fn what_cannot_be_served_is_refused_in_one_line_before_anything_is_made() {
    let Some(place) = place() else { return };
    let odd = format!("{OURS}Odd-v0");
    let endless = format!("{OURS}Endless-v0");
    let fails = format!("{OURS}Fails-v0");
    for (arguments, part) in [
        (vec!["gym:Nonsense-v9"], "Nonsense"),
        (vec![&odd], "only Box and Discrete can be served"),
        (vec![&endless], "environment.max_episode_steps=1000"),
        (vec![&fails], "how"),
        (vec!["gym:no_such_module:X-v0"], "no_such_module"),
        (
            vec!["gym:Pendulum-v1", "--set", r#"environment.server=["no-such-program"]"#],
            "cannot start the environment server no-such-program",
        ),
        (
            vec!["gym:Pendulum-v1", "--set", r#"environment.server=["true"]"#],
            "ended",
        ),
        (
            vec![
                "gym:Pendulum-v1",
                "--set",
                r#"environment.server=["python3","-S","-m","shoal_gym"]"#,
            ],
            "pip install ./python",
        ),
        (
            vec!["gym:CartPole-v1", "--set", "ddpg.gamma=0.9"],
            "ddpg cannot control",
        ),
    ] {
        let arguments: Vec<&str> = arguments.into_iter().collect();
        let said = complaint(&place.output(&[&["train"], &arguments[..]].concat()));
        assert!(said.contains(part), "{arguments:?}: {said}");
        assert!(!place.path().join("runs").exists(), "{arguments:?}");
    }
}

#[test]
fn servers_end_with_their_launcher_and_the_run_goes_on_when_it_is_resumed() {
    let Some(place) = place() else { return };
    let endless = ["--steps", "100000000"];
    let running = place.start_in("run", "gym:Pendulum-v1", &[&SHORT[..], &endless].concat());
    running.learns_on();
    running.signal(Signal::KILL);
    until("no process is left", || running.leftovers().processes().is_empty());
    let resumed = place.resume("run", &[]);
    resumed.learns_on();
    assert!(place.output(&["stop", "run"]).status.success());
    let (code, _, leftovers) = resumed.wait();
    assert_eq!(code, Some(0));
    assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
}

#[test]
fn the_way_through_shared_memory_is_measured_beside_gymnasiums_own_vectors() {
    let Some(place) = place() else { return };
    let mut bench = place.shoal(&["bench", "gym", "--json"]);
    let output = bench.env("SHOAL_BENCH_SECONDS", "0.4").output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let figures = support::json(&output);
    let number = |field: &str| figures[field].as_f64().unwrap();
    assert!(0.0 < number("round_trip_median_us"));
    assert!(number("round_trip_median_us") <= number("round_trip_p99_us"));
    for vector in ["", "sync_vector_", "async_vector_"] {
        assert!(number(&format!("{vector}steps_per_second")) > 0.0, "{figures}");
    }
}
