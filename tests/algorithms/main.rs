//! The algorithms other than DDPG, in real processes. Q-learning finds the lake's values. In lockstep, each algorithm
//! gives the same bits as its single-process twin, even if roles are killed. A run ends after a given number of
//! episodes.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod lake;
#[path = "../support/mod.rs"]
mod support;
mod twin;
#[path = "../support/value_iteration.rs"]
mod value_iteration;

use rustix::process::Signal;
use shoal_common::config::{AlgorithmConfig, Config};
use shoal_common::policy::{PolicyLayout, argmax};
use shoal_common::policy_file::PolicyFile;
use shoal_env_server::environment::frozen_lake::{ACTIONS, STATES};
use shoal_learner::algorithms::dqn::Dqn;
use shoal_learner::algorithms::registry;
use shoal_learner::algorithms::sac::Sac;
use shoal_learner::algorithms::td3::Td3;
use shoal_learner::networks::digest::sha256;
use shoal_learner::process::checkpoint::Checkpoints;
use shoal_run::records::recorder::read_learner;
use support::{Running, Workplace, error_line, final_result, gets_rows, json, parse, until, wait_for_rows};

/// Rare evaluations of few episodes.
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

/// The final table of the run.
fn table(place: &Workplace) -> Vec<f32> {
    let layout = PolicyLayout::Table {
        states: STATES,
        actions: ACTIONS,
    };
    let file = place.path().join("run/checkpoints/last.policy");
    PolicyFile::read(&file, &layout).unwrap().parameters
}

fn greedy(values: &[f32]) -> Vec<usize> {
    values.chunks(ACTIONS).map(argmax).collect()
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
fn free_q_learning_learns_from_each_row_once_also_with_a_small_ring() {
    let place = Workplace::new();
    let set = ["run.mode=free", "replay.capacity=300", "replay.tolerance=20000"];
    let set = set.map(|key| ["--set", key]).concat();
    let result = train(
        &place,
        &[&["frozen-lake", "--steps", "50000", "--episodes", "1000000"], &set[..]].concat(),
    );
    assert_eq!(result["updates"], 50_000);
    let log = std::fs::read_to_string(place.path().join("run/shoal.log")).unwrap();
    assert!(!log.contains("were overwritten"), "{log}");

    // Together, the actors' full windows hold more rows than the ring.
    let set = ["run.mode=free", "replay.capacity=300", "replay.tolerance=20000"];
    let set = [
        set.map(|key| ["--set", key]).concat(),
        vec!["--actors", "2", "--envs", "256"],
    ]
    .concat();
    let long = ["frozen-lake", "--steps", "100000000", "--episodes", "100000000"];
    let running = start(&place, "stopped", &[&long[..], &set].concat());
    running.wait_for_learning();
    assert!(place.output(&["stop", "stopped"]).status.success());
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
    let steps = place.status("stopped")["env_steps"].as_u64().unwrap() + 100;
    let output = place.output(&["resume", "stopped", "--steps", &steps.to_string(), "--json"]);
    assert_eq!(json(&output)["updates"], steps);
    let log = std::fs::read_to_string(place.path().join("stopped/shoal.log")).unwrap();
    assert!(!log.contains("were overwritten"), "{log}");
}

#[test]
fn every_episode_is_recorded_however_many_end_in_a_chunk() {
    let place = Workplace::new();
    // With a window of one chunk, little more is sent than is learned from.
    let set = [
        "actors.chunk_steps=64",
        "actors.max=1",
        "actors.window=1",
        "replay.updates_per_step=0",
        "replay.capacity=1000000",
    ];
    let set = set.map(|key| ["--set", key]).concat();
    let size = [
        "--actors",
        "1",
        "--envs",
        "2048",
        "--steps",
        "1310720",
        "--episodes",
        "100000000",
    ];
    let result = train(
        &place,
        &[&["cart-pole", "--method", "dqn"], &size[..], &set[..]].concat(),
    );
    let ended = result["episodes"].as_u64().unwrap();
    let most_of_a_buffer = 10 * 4_096;
    assert!(
        recorded(&place, "run") >= ended && ended > most_of_a_buffer,
        "{ended} episodes ended"
    );
}

#[test]
fn q_learning_gives_the_bits_of_algorithm_2_in_a_single_process() {
    gives_the_bits_of_its_twin("frozen-lake", "q-learning");
}

#[test]
fn sarsa_gives_the_bits_of_algorithm_1_in_a_single_process() {
    gives_the_bits_of_its_twin("frozen-lake-sarsa", "sarsa");
}

fn gives_the_bits_of_its_twin(preset: &str, section: &str) {
    let place = Workplace::new();
    // With a limit of 30 steps and so much exploration, some episodes are truncated and some reach the goal.
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
        "{truncated} episodes truncated, {learned} values learned: too few for this test"
    );
    assert_eq!(result["weights_sha256"], weights);
}

#[test]
fn reinforce_gives_the_bits_of_algorithm_3_in_a_single_process() {
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

/// A short lockstep run of one actor whose chunks are single steps. Returns its configuration and its result.
fn step_by_step(place: &Workplace, preset: &str, algorithm: &str, set: &[&str]) -> (Config, serde_json::Value) {
    let head = ["--method", algorithm, "--lockstep", "--actors", "1", "--envs", "1"];
    let head = [&[preset][..], &head, &["--steps", "900", "--seed", "11"]].concat();
    let set = [&["actors.chunk_steps=1", "replay.warmup=300"], set].concat();
    let set = set.into_iter().flat_map(|assignment| ["--set", assignment]);
    let result = train(place, &head.into_iter().chain(set).collect::<Vec<_>>());
    let config = Config::load(&place.path().join("run/config.toml")).unwrap();
    (config, result)
}

#[test]
fn td3_gives_the_bits_of_its_algorithm_in_a_single_process() {
    for threads in ["learner.threads=1", "learner.threads=2"] {
        let place = Workplace::new();
        // Large enough to be split between two threads.
        let set = ["td3.hidden=[64, 128]", "td3.batch=64", threads];
        let (config, result) = step_by_step(&place, "pendulum", "td3", &set);
        let AlgorithmConfig::Td3(settings) = &config.algorithm else {
            panic!("{:?}", config.algorithm)
        };
        let algorithm = Td3::new(&config.spec, settings, 11).unwrap();
        assert_eq!(
            result["weights_sha256"],
            twin::of_minibatches(&config, algorithm),
            "{threads}"
        );
    }
}

#[test]
fn sac_gives_the_bits_of_its_algorithm_in_a_single_process() {
    for threads in ["learner.threads=1", "learner.threads=2"] {
        let place = Workplace::new();
        let set = ["sac.hidden=[64, 128]", "sac.batch=64", threads];
        let (config, result) = step_by_step(&place, "point-mass-r3", "sac", &set);
        let AlgorithmConfig::Sac(settings) = &config.algorithm else {
            panic!("{:?}", config.algorithm)
        };
        let algorithm = Sac::new(&config.spec, settings, 11).unwrap();
        assert_eq!(
            result["weights_sha256"],
            twin::of_minibatches(&config, algorithm),
            "{threads}"
        );
        // It begins at 1, and an update changes it by about 3e-4 of its value.
        let records = read_learner(&place.path().join("run/learner.csv")).unwrap();
        let temperatures: Vec<f64> = records.iter().filter_map(|record| record.temperature).collect();
        assert!(
            temperatures.last().is_some_and(|last| (0.8..1.0).contains(last)),
            "{temperatures:?}"
        );
    }
}

#[test]
fn dqn_gives_the_bits_of_its_algorithm_in_a_single_process() {
    for variant in ["dqn.dueling=false", "dqn.dueling=true", "replay.n_step=3"] {
        let place = Workplace::new();
        let set = [
            "dqn.hidden=[24, 16]",
            "dqn.target_every=20",
            "dqn.epsilon_steps=700",
            variant,
        ];
        let (config, result) = step_by_step(&place, "cart-pole", "dqn", &set);
        let AlgorithmConfig::Dqn(settings) = &config.algorithm else {
            panic!("{:?}", config.algorithm)
        };
        let algorithm = Dqn::new(&config.spec, settings, 11).unwrap();
        assert_eq!(
            result["weights_sha256"],
            twin::of_minibatches(&config, algorithm),
            "{variant}"
        );
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

/// Two actors of two environments each, with `algorithm` and small networks.
fn small(preset: &'static str, algorithm: &'static str, hidden: &'static str) -> Vec<&'static str> {
    let head = ["--method", algorithm, "--lockstep", "--actors", "2", "--envs", "2"];
    let set = [
        "actors.chunk_steps=4",
        "replay.warmup=300",
        "checkpoint.every_updates=1500",
        hidden,
    ];
    let set = set.into_iter().flat_map(|assignment| ["--set", assignment]);
    let head = [&[preset][..], &head, &["--steps", "12000", "--episodes", "100000"]].concat();
    head.into_iter().chain(set).collect()
}

#[test]
fn td3_with_killed_roles_ends_with_the_bits_of_an_undisturbed_run() {
    kills_do_not_change_the_bits(&small("pendulum", "td3", "td3.hidden=[8, 8]"));
}

#[test]
fn sac_with_killed_roles_ends_with_the_bits_of_an_undisturbed_run() {
    kills_do_not_change_the_bits(&small("pendulum", "sac", "sac.hidden=[8, 8]"));
}

#[test]
fn dqn_with_killed_roles_ends_with_the_bits_of_an_undisturbed_run() {
    kills_do_not_change_the_bits(&small("cart-pole", "dqn", "dqn.hidden=[8, 8]"));
}

#[test]
fn transitions_of_several_steps_survive_kills_bit_for_bit() {
    let set = ["--set", "replay.n_step=5", "--set", "actors.chunk_steps=1"];
    kills_do_not_change_the_bits(&[&small("cart-pole", "dqn", "dqn.hidden=[8, 8]")[..], &set].concat());
}

#[test]
fn each_observation_counts_once_however_often_roles_are_killed() {
    let set = ["--set", "observation.normalise=true", "--set", "reward.scale=0.1"];
    kills_do_not_change_the_bits(&[&small("pendulum", "sac", "sac.hidden=[8, 8]")[..], &set].concat());
}

/// A normalised policy is not determined by its network alone.
#[test]
fn the_digest_of_the_weights_includes_the_statistics_of_normalised_observations() {
    let place = Workplace::new();
    let set = ["sac.hidden=[8, 8]", "replay.warmup=300", "observation.normalise=true"];
    let set = set.into_iter().flat_map(|assignment| ["--set", assignment]);
    let arguments = ["pendulum", "--method", "sac", "--lockstep", "--steps", "1500"];
    let result = train(&place, &arguments.into_iter().chain(set).collect::<Vec<_>>());
    let run = place.path().join("run");
    let config = Config::load(&run.join("config.toml")).unwrap();
    let loaded = Checkpoints::new(&run.join("checkpoints"), config.fingerprint()).load_newest();
    let sections = loaded.unwrap().unwrap().checkpoint.arrays;
    let digest = |names: &[&str]| {
        let learned = names
            .iter()
            .map(|name| sections.iter().find(|(found, _)| found == name));
        sha256(&learned.map(|section| section.unwrap().1.as_slice()).collect::<Vec<_>>())
    };
    let weight_names = registry::weight_names(&config);
    let (statistics, network) = weight_names.split_last().unwrap();
    assert_eq!(*statistics, "observations");
    assert_eq!(result["weights_sha256"], digest(&weight_names));
    assert_ne!(result["weights_sha256"], digest(network));
}

#[test]
fn reinforce_with_killed_roles_ends_with_the_bits_of_an_undisturbed_run() {
    kills_do_not_change_the_bits(&CART_POLE);
}

#[test]
fn sarsa_with_killed_roles_ends_with_the_bits_of_an_undisturbed_run() {
    kills_do_not_change_the_bits(&SARSA);
}

fn kills_do_not_change_the_bits(arguments: &[&str]) {
    let place = Workplace::new();
    let (weights, evaluations) = final_result(start(&place, "undisturbed", arguments));
    // On a busy machine a run may be over before every role was killed.
    let all_killed = |running: &Running| {
        ["actor-1", "learner-0", "env-server-0", "actor-0", "learner-0"]
            .iter()
            .all(|who| {
                if !gets_rows(running, 500) {
                    return false;
                }
                let starts = running.pids(who).len();
                running.kill(who);
                until("it is replaced", || running.pids(who).len() > starts);
                true
            })
            && gets_rows(running, 500)
    };
    let names = (0..20).map(|attempt| format!("killed-{attempt}"));
    let runs = names.map(|name| (start(&place, &name, arguments), name));
    let (running, name) = runs.into_iter().find(|(running, _)| all_killed(running)).unwrap();
    running.kill_all();
    drop(running);
    let (again, evaluated) = final_result(place.resume(&name, &[]));
    assert_eq!(again, weights);
    // One may have been lost with the launcher before it was recorded.
    assert!(evaluated.iter().all(|line| evaluations.contains(line)), "{evaluated:?}");
}

#[test]
fn a_run_limited_by_episodes_plays_that_many_and_resumes_where_it_stopped() {
    for preset in ["frozen-lake", "cart-pole"] {
        let place = Workplace::new();
        let undisturbed = train(&place, &[preset, "--episodes", "900"]);
        assert_eq!(undisturbed["episodes"], 900);
        // An actor may finish the first episode of the next round before it learns of the end.
        assert!((900..=901).contains(&recorded(&place, "run")), "{preset}");

        let running = start(&place, "stopped", &[preset, "--episodes", "900"]);
        wait_for_rows(&running, 500);
        running.signal(Signal::INT);
        let (code, printed, leftovers) = running.wait();
        assert_eq!(code, Some(130));
        assert!(leftovers.processes().is_empty() && leftovers.files().is_empty());
        assert!(
            parse(&printed)["episodes"].as_u64().unwrap() < 900,
            "it was stopped too late"
        );
        let result = json(&place.output(&["resume", "stopped", "--json"]));
        for key in ["weights_sha256", "episodes", "env_steps"] {
            assert_eq!(result[key], undisturbed[key], "{preset}: {key}");
        }

        let message = error_line(&place.output(&["resume", "stopped"]));
        assert!(
            message.contains("finished 900 of 900 episodes") && message.contains("--episodes"),
            "{message}"
        );
        let more = ["--episodes", "950", "--json"];
        let [result, longer] =
            ["stopped", "run"].map(|run| json(&place.output(&[&["resume", run], &more[..]].concat())));
        assert_eq!((&result["episodes"], &longer["episodes"]), (&950.into(), &950.into()));
        assert_eq!(result["weights_sha256"], longer["weights_sha256"]);
    }
}

#[test]
fn q_learning_also_learns_in_a_free_run() {
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
    // Both actors continue until they learn of the end. The learner ignores what they send in the meantime.
    assert!((300..400).contains(&episodes), "{result}");
    assert_eq!(result["updates"], result["env_steps"]);
    assert!(recorded(&place, "run") >= episodes);
    assert!(table(&place).iter().all(|value| (0.0..=1.0).contains(value)));
}
