//! What learns beside DDPG, in real processes: Q-learning finds the lake's values, each method has the bits of its algorithm
//! in a single process, and keeps them whoever is killed; a run ends after so many episodes.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod lake;
#[path = "../support/mod.rs"]
mod support;
mod twin;
#[path = "../support/value_iteration.rs"]
mod value_iteration;

use rustix::process::Signal;
use shoal_common::config::Config;
use shoal_common::policy::{PolicyLayout, highest};
use shoal_common::policy_file::PolicyFile;
use shoal_env_server::environment::frozen_lake::{ACTIONS, STATES};
use support::{Running, Workplace, comes_further, complaint, end_of, json, parse, until};

/// Few episodes to evaluate by, and those not often.
const QUICK: [&str; 6] = [
    "--set",
    "evaluation.every=4000",
    "--set",
    "evaluation.episodes=2",
    "--set",
    "evaluation.final_episodes=3",
];

/// Trains in `run` and returns what `--json` printed.
fn train(place: &Workplace, arguments: &[&str]) -> serde_json::Value {
    let output = place.output(&[&["train"], arguments, &QUICK, &["--run", "run", "--json"]].concat());
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    json(&output)
}

fn start(place: &Workplace, name: &str, arguments: &[&str]) -> Running {
    place.launch(name, &[&["train"], arguments, &QUICK, &["--run", name]].concat())
}

/// The table that a run ended with.
fn table(place: &Workplace) -> Vec<f32> {
    let layout = PolicyLayout::Table {
        states: STATES,
        actions: ACTIONS,
    };
    let file = place.path().join("run/checkpoints/last.policy");
    PolicyFile::read(&file, &layout).unwrap().parameters
}

fn greedy(values: &[f32]) -> Vec<usize> {
    values.chunks(ACTIONS).map(highest).collect()
}

/// Lines of `episodes.csv` below the header.
fn recorded(place: &Workplace, run: &str) -> u64 {
    let episodes = std::fs::read_to_string(place.path().join(run).join("episodes.csv")).unwrap();
    episodes.lines().count() as u64 - 1
}

#[test]
fn q_learning_finds_the_values_of_the_lake_and_a_policy_that_reaches_the_goal() {
    let place = Workplace::new();
    train(
        &place,
        &[
            "frozen-lake",
            "--steps",
            "200000",
            "--episodes",
            "1000000",
            "--set",
            "actors.chunk_steps=50",
            "--set",
            "q-learning.epsilon=0.7",
        ],
    );
    let (learned, optimal) = (table(&place), value_iteration::optimal_values(0.999));
    let furthest = optimal
        .as_flattened()
        .iter()
        .zip(&learned)
        .map(|(q, learned)| (q - f64::from(*learned)).abs())
        .fold(0.0, f64::max);
    assert!(furthest < 0.15, "{furthest} from q*: {learned:?}");
    let best: Vec<f32> = optimal.as_flattened().iter().map(|q| *q as f32).collect();
    let [reached, possible] = [&learned, &best].map(|values| lake::reaches_the_goal(&greedy(values), 100));
    assert!((0.70..0.76).contains(&possible), "{possible}");
    assert!(reached > 0.6, "{reached} of {possible}: {learned:?}");
}

#[test]
fn a_step_at_a_time_q_learning_is_algorithm_2_in_a_single_process() {
    is_its_algorithm("frozen-lake", "q-learning");
}

#[test]
fn a_step_at_a_time_sarsa_is_algorithm_1_in_a_single_process() {
    is_its_algorithm("frozen-lake-sarsa", "sarsa");
}

fn is_its_algorithm(preset: &str, section: &str) {
    let place = Workplace::new();
    // Within 30 steps some episodes are cut off, and some of so much exploration reach the goal.
    let [epsilon, alpha] = ["epsilon=0.9", "alpha=0.3"].map(|setting| format!("{section}.{setting}"));
    let limit = "environment.time_limit=30";
    let result = train(
        &place,
        &[
            preset,
            "--seed",
            "11",
            "--episodes",
            "900",
            "--set",
            limit,
            "--set",
            &epsilon,
            "--set",
            &alpha,
        ],
    );
    let config = Config::load(&place.path().join("run/config.toml")).unwrap();
    let (weights, truncated, learned) = twin::tabular(&config);
    assert!(
        truncated > 0 && learned > 8,
        "or this shows less: {truncated}, {learned}"
    );
    assert_eq!(result["weights_sha256"], weights);
}

#[test]
fn an_episode_at_a_time_reinforce_is_algorithm_3_in_a_single_process() {
    for weight in ["normalised", "baseline"] {
        let place = Workplace::new();
        let weight = format!("reinforce.weight={weight}");
        let result = train(
            &place,
            &["cart-pole", "--seed", "11", "--episodes", "60", "--set", &weight],
        );
        let config = Config::load(&place.path().join("run/config.toml")).unwrap();
        assert_eq!(result["weights_sha256"], twin::reinforce(&config), "{weight}");
    }
}

const CART_POLE: [&str; 9] = [
    "cart-pole",
    "--actors",
    "2",
    "--episodes",
    "100000",
    "--steps",
    "30000",
    "--set",
    "checkpoint.every_updates=1500",
];

const SARSA: [&str; 17] = [
    "frozen-lake-sarsa",
    "--actors",
    "2",
    "--envs",
    "2",
    "--episodes",
    "100000",
    "--steps",
    "40000",
    "--set",
    "actors.chunk_steps=4",
    "--set",
    "sarsa.epsilon=0.9",
    "--set",
    "sarsa.alpha=0.3",
    "--set",
    "checkpoint.every_updates=1500",
];

#[test]
fn whoever_is_killed_reinforce_ends_with_the_bits_of_a_whole_run() {
    whoever_is_killed_it_ends_the_same(&CART_POLE);
}

#[test]
fn whoever_is_killed_sarsa_ends_with_the_bits_of_a_whole_run() {
    whoever_is_killed_it_ends_the_same(&SARSA);
}

fn whoever_is_killed_it_ends_the_same(arguments: &[&str]) {
    let place = Workplace::new();
    let (weights, evaluations) = end_of(start(&place, "whole", arguments));
    let running = start(&place, "killed", arguments);
    for who in ["actor-1", "learner-0", "env-server-0", "actor-0", "learner-0"] {
        comes_further(&running, 1000);
        let starts = running.pids(who).len();
        running.kill(who);
        until("it is replaced", || running.pids(who).len() > starts);
    }
    comes_further(&running, 1000);
    running.kill_everybody();
    drop(running);
    let (again, evaluated) = end_of(place.resume("killed", &[]));
    assert_eq!(again, weights);
    // One may have died with the launcher before it was written down.
    assert!(evaluated.iter().all(|line| evaluations.contains(line)), "{evaluated:?}");
}

#[test]
fn a_run_of_so_many_episodes_has_them_and_goes_on_where_it_was_broken_off() {
    for preset in ["frozen-lake", "cart-pole"] {
        let place = Workplace::new();
        let whole = train(&place, &[preset, "--episodes", "900"]);
        assert_eq!(whole["episodes"], 900);
        // An actor may have done the first of the next round before it heard of the end.
        assert!((900..=901).contains(&recorded(&place, "run")), "{preset}");

        let running = start(&place, "broken-off", &[preset, "--episodes", "900"]);
        comes_further(&running, 500);
        running.signal(Signal::INT);
        let (code, printed, leftovers) = running.wait();
        assert_eq!(code, Some(130));
        assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
        assert!(
            parse(&printed)["episodes"].as_u64().unwrap() < 900,
            "or nothing was broken off"
        );
        let result = json(&place.output(&["resume", "broken-off", "--json"]));
        for key in ["weights_sha256", "episodes", "env_steps"] {
            assert_eq!(result[key], whole[key], "{preset}: {key}");
        }

        let said = complaint(&place.output(&["resume", "broken-off"]));
        assert!(
            said.contains("finished 900 of 900 episodes") && said.contains("--episodes"),
            "{said}"
        );
        let more = ["--episodes", "950", "--json"];
        let [result, longer] =
            ["broken-off", "run"].map(|run| json(&place.output(&[&["resume", run], &more[..]].concat())));
        assert_eq!((&result["episodes"], &longer["episodes"]), (&950.into(), &950.into()));
        assert_eq!(result["weights_sha256"], longer["weights_sha256"]);
    }
}

#[test]
fn q_learning_needs_no_turns() {
    let place = Workplace::new();
    let arguments = [
        "frozen-lake",
        "--set",
        "run.mode=free",
        "--actors",
        "2",
        "--episodes",
        "300",
    ];
    let result = train(&place, &arguments);
    let episodes = result["episodes"].as_u64().unwrap();
    // Both actors go on until they hear of the end, and what they sent is learned from by nobody.
    assert!((300..400).contains(&episodes), "{result}");
    assert_eq!(result["updates"], result["env_steps"]);
    assert!(recorded(&place, "run") >= episodes);
    assert!(table(&place).iter().all(|value| (0.0..=1.0).contains(value)));
}
