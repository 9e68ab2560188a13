//! Lockstep runs with the same seed give the same bits, with any timing and any kills. With one actor and one
//! environment they give the bits of Algorithm 4 in a single process.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use rand::RngExt;
use shoal_actor::noise::OrnsteinUhlenbeck;
use shoal_common::channel::environment::ResponseLayout;
use shoal_common::commit::CommitReader;
use shoal_common::config::{AlgorithmConfig, Config, Warmup};
use shoal_common::network::{ActionRange, DeterministicPolicy};
use shoal_common::stream::{Purpose, seek, stream};
use shoal_common::transition::Transition;
use shoal_env_server::vector::{Reset, VectorEnvironment};
use shoal_learner::algorithms::ddpg::Ddpg;
use shoal_learner::algorithms::minibatch::Minibatch;
use shoal_learner::algorithms::minibatch_algorithm::MinibatchAlgorithm;
use shoal_learner::algorithms::sampling::Sampler;
use support::{QUICK, Running, Workplace, final_result, json, until, wait_for_rows};

#[test]
fn the_same_seed_gives_the_same_bits_and_another_seed_gives_others() {
    let place = Workplace::new();
    let run = |seed| {
        let result = place.train(&[
            "pendulum",
            "--lockstep",
            "--actors",
            "3",
            "--steps",
            "700",
            "--seed",
            seed,
        ]);
        (
            result["weights_sha256"].clone(),
            result["env_steps"].clone(),
            result["updates"].clone(),
        )
    };
    let first = run("5");
    assert_eq!((first.1.as_u64(), first.2.as_u64()), (Some(700), Some(636)));
    assert_eq!(run("5"), first);
    assert_ne!(run("6").0, first.0);
}

#[test]
fn a_learner_gives_the_same_bits_with_one_thread_and_with_two() {
    let place = Workplace::new();
    let [one, two] = ["1", "2"].map(|threads| {
        let setting = format!("learner.threads={threads}");
        let running = place.start_as(
            threads,
            &[
                "--lockstep",
                "--steps",
                // Long enough to look at its threads.
                "10000",
                "--set",
                &setting,
                "--set",
                // Large enough to be split between two threads.
                "ddpg.hidden=[40,128]",
                "--set",
                "evaluation.final_episodes=1",
            ],
        );
        let tasks = std::fs::read_dir(format!("/proc/{}/task", running.pids("learner-0")[0])).unwrap();
        let mut names =
            tasks.map(|task| std::fs::read_to_string(task.unwrap().path().join("comm")).unwrap_or_default());
        let has_second = names.any(|name| name.trim() == "learner-2");
        assert_eq!(has_second, threads == "2", "whether it has a second thread");
        final_result(running)
    });
    assert_eq!(one, two);
}

const SHARED: [&str; 13] = [
    "--lockstep",
    "--actors",
    "2",
    "--envs",
    "2",
    "--steps",
    "60000",
    "--set",
    "checkpoint.every_updates=700",
    "--set",
    "evaluation.every=1500",
    "--set",
    "replay.capacity=1500",
];

#[test]
fn a_lockstep_run_with_killed_roles_ends_with_the_bits_of_an_undisturbed_one() {
    let place = Workplace::new();
    let undisturbed = final_result(place.start("undisturbed", &SHARED));
    let running = place.start("killed", &SHARED);
    for who in [
        "actor-1",
        "learner-0",
        "env-server-0",
        "evaluator-0",
        "env-server-16",
        "learner-0",
        "actor-0",
        "env-server-1",
        "actor-1",
        "learner-0",
    ] {
        wait_for_rows(&running, 2000);
        let starts = running.pids(who).len();
        running.kill(who);
        until("it is replaced", || running.pids(who).len() > starts);
    }
    assert_eq!(final_result(running), undisturbed);
}

#[test]
fn an_evaluator_killed_while_a_new_learner_repeats_rounds_does_not_block_the_run() {
    let place = Workplace::new();
    let arguments = [
        "--lockstep",
        "--steps",
        "6000",
        "--set",
        "evaluation.every=1500",
        "--set",
        // No checkpoint, so that a new learner starts from the beginning; and slow gradient steps.
        "checkpoint.every_updates=100000",
        "--set",
        "ddpg.batch=1024",
        "--set",
        "ddpg.hidden=[24,16]",
        "--set",
        "replay.warmup=64",
        "--set",
        // Long enough to be interrupted.
        "evaluation.episodes=10000",
        "--set",
        "evaluation.final_episodes=3",
    ];
    let undisturbed = final_result(place.start_as("undisturbed", &arguments));
    // Versions of the policies that were evaluated.
    let evaluated = |running: &Running| {
        let evaluations = csv::Reader::from_path(running.run.join("evaluations.csv"));
        let versions = evaluations
            .unwrap()
            .into_records()
            .map(|row| row.unwrap()[3].parse().unwrap());
        versions.collect::<Vec<u64>>()
    };
    // Stops the evaluator during its third evaluation. On a busy machine that may come too late.
    let stopped_in_time = |running: &Running| {
        until("the policies of two periods are evaluated", || {
            evaluated(running).len() >= 2
        });
        let before = evaluated(running)[1];
        let name = running.run.file_name().unwrap().to_str().unwrap();
        until("the evaluator is evaluating the next one", || {
            place.role(name, "evaluator-0")["policy_version"].as_u64() > Some(before)
        });
        running.stop_role("evaluator-0");
        evaluated(running).len() == 2
    };
    let mut runs = (0..20).map(|attempt| place.start_as(&format!("killed-{attempt}"), &arguments));
    let running = runs.find(stopped_in_time).unwrap();
    let name = running.run.file_name().unwrap().to_str().unwrap();
    // It continues when the new learner has begun to repeat the rounds.
    running.kill("learner-0");
    until("there is a new learner", || running.pids("learner-0").len() >= 2);
    until("it is working", || place.role(name, "learner-0")["state"] == "working");
    running.stop_role("learner-0");
    running.continue_role("evaluator-0");
    until("the policy is evaluated", || evaluated(&running).len() == 3);
    running.kill("evaluator-0");
    until("there is a new evaluator", || running.pids("evaluator-0").len() >= 2);
    running.continue_role("learner-0");
    assert_eq!(final_result(running), undisturbed);
}

#[test]
fn an_actor_killed_before_its_first_chunk_restarts_from_the_beginning() {
    let place = Workplace::new();
    // The longest chunks possible, so that the kills come before the first one is sent.
    let arguments = [&SHARED[..], &["--set", "actors.chunk_steps=4096"]].concat();
    let undisturbed = final_result(place.start("undisturbed", &arguments));
    // A fast actor may have sent its first chunk before it is stopped. Then this is tried again.
    let killed_in_time = |running: &Running| {
        let commits = CommitReader::open(&running.run.join("replay.bin")).unwrap();
        ["actor-0", "actor-1"].into_iter().enumerate().all(|(actor, who)| {
            // After its handshake an actor begins its first chunk. The learner accepts the second actor's handshake
            // after the first actor's chunk.
            until("the learner has accepted its handshake", || {
                commits.committed(actor).incarnation > 0
            });
            running.stop_role(who);
            let is_in_time = commits.actor(actor).rows == 0;
            let starts = running.pids(who).len();
            running.kill(who);
            until("it is replaced", || running.pids(who).len() > starts);
            is_in_time
        })
    };
    let mut runs = (0..20).map(|attempt| place.start(&format!("killed-{attempt}"), &arguments));
    let running = runs.find(killed_in_time).unwrap();
    assert_eq!(final_result(running), undisturbed);
}

#[test]
fn a_lockstep_run_interrupted_several_times_ends_with_the_bits_of_an_undisturbed_one() {
    let place = Workplace::new();
    let (weights, evaluations) = final_result(place.start("undisturbed", &SHARED));
    let mut running = place.start("stopped", &SHARED);
    for _ in 0..3 {
        wait_for_rows(&running, 5000);
        assert!(place.output(&["stop", "stopped"]).status.success());
        running.wait();
        running = place.resume("stopped", &[]);
    }
    assert_eq!(final_result(running), (weights.clone(), evaluations.clone()));

    let mut running = place.start("killed", &SHARED);
    for _ in 0..3 {
        wait_for_rows(&running, 5000);
        running.kill_all();
        drop(running);
        running = place.resume("killed", &[]);
    }
    assert_eq!(final_result(running), (weights, evaluations));
}

#[test]
fn a_learner_that_makes_no_updates_needs_no_row_again() {
    let place = Workplace::new();
    let arguments = [
        "--lockstep",
        "--steps",
        "200000",
        "--set",
        "replay.updates_per_step=0",
        "--set",
        "replay.capacity=1000",
    ];
    let running = place.start("run", &arguments);
    wait_for_rows(&running, 5000);
    running.kill("learner-0");
    assert_eq!(running.wait().0, Some(0), "{}", place.stderr());
}

#[test]
fn one_lockstep_actor_gives_the_bits_of_algorithm_4_in_a_single_process() {
    for (preset, warmup) in [
        ("pendulum", "policy"),
        ("point-mass-r2", "policy"),
        ("point-mass-r2", "uniform"),
    ] {
        let warmup = format!("exploration.warmup={warmup}");
        let place = Workplace::new();
        let result = place.train(&[
            preset,
            "--run",
            "run",
            "--lockstep",
            "--actors",
            "1",
            "--envs",
            "1",
            "--steps",
            "900",
            "--seed",
            "11",
            "--set",
            "actors.chunk_steps=1",
            "--set",
            "evaluation.every=300",
            "--set",
            &warmup,
        ]);
        let config = Config::load(&place.path().join("run/config.toml")).unwrap();
        assert_eq!(result["weights_sha256"], twin(&config), "{preset}, {warmup}");
    }
}

#[test]
fn three_tanh_layers_give_the_bits_of_a_single_process_with_one_thread_and_with_two() {
    let place = Workplace::new();
    for threads in ["1", "2"] {
        let learner_threads = format!("learner.threads={threads}");
        let arguments = [
            &[
                "train",
                "pendulum",
                "--run",
                threads,
                "--json",
                "--lockstep",
                "--actors",
                "1",
                "--envs",
                "1",
            ],
            &["--steps", "900", "--seed", "11"][..],
            &QUICK,
            // Large enough to be split between two threads.
            &["--set", "ddpg.hidden=[40, 128, 130]", "--set", "ddpg.activation=tanh"],
            &["--set", "actors.chunk_steps=1", "--set", &learner_threads],
        ];
        let output = place.output(&arguments.concat());
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let config = Config::load(&place.path().join(threads).join("config.toml")).unwrap();
        assert_eq!(json(&output)["weights_sha256"], twin(&config), "{threads} threads");
    }
}

/// Algorithm 4 as a plain single-process program. Returns the SHA-256 of its final weights.
fn twin(config: &Config) -> String {
    let seed = config.run.seed;
    let row = config.row_layout();
    let AlgorithmConfig::Ddpg(ddpg) = &config.algorithm else {
        panic!("this twin is for DDPG")
    };
    let exploration = &ddpg.exploration;
    let mut learner = Ddpg::new(&config.spec, ddpg, seed).unwrap();
    let sampler = Sampler::new(seed);
    let mut batch = Minibatch::new(row, ddpg.batch);
    let mut indices = vec![0; ddpg.batch];

    let range = ActionRange::new(&config.spec.action).unwrap();
    let mut mu = DeterministicPolicy::new(ddpg.networks(&config.spec).actor, range, 1);
    let mut uniform = stream(seed, Purpose::Exploration, 0, 0);
    let mut noise = OrnsteinUhlenbeck::new(exploration, 1, row.action_width(), uniform.clone());

    let environment = &config.environment;
    let mut environment = VectorEnvironment::new(&environment.name, &environment.parameters, 1, seed, 0, 0).unwrap();
    let layout = ResponseLayout::new(1, row.observation_width());
    let mut response = vec![0.0; layout.len()];
    let mut replay: Vec<Vec<f32>> = Vec::new();

    let mut s = vec![0.0; row.observation_width()];
    let mut a = vec![0.0; row.action_width()];
    environment.reset(Reset::Next, &mut s).unwrap();
    for t in 0..config.run.steps {
        if learner.updates() == 0 && exploration.warmup == Warmup::Uniform {
            let uniform = seek(&mut uniform, t);
            for (i, a) in a.iter_mut().enumerate() {
                *a = mu.range().action(i, uniform.random_range(-1.0..=1.0));
            }
        } else {
            mu.forward(learner.policy(), &s, &mut a);
            noise.advance(t);
            noise.add_to(&mut a, mu.range());
        }

        environment.step(&a, layout.split_mut(&mut response)).unwrap();
        let step = layout.split_mut(&mut response);
        let (terminated, truncated) = (step.terminated[0] != 0.0, step.truncated[0] != 0.0);
        let mut stored = vec![0.0; row.width()];
        row.write(
            &Transition {
                s: &s,
                a: &a,
                r: step.rewards[0],
                discount: if terminated { 0.0 } else { ddpg.gamma as f32 },
                s_next: step.next_observations,
                last: terminated || truncated,
            },
            &mut stored,
        );
        replay.push(stored);
        if terminated || truncated {
            noise.reset(0);
        }
        s.copy_from_slice(step.observations);

        // One gradient step for each environment step beyond the warm-up.
        if replay.len() as u64 > config.replay.warmup {
            let rows = replay.len() as u64;
            sampler.indices(
                learner.updates(),
                rows.saturating_sub(config.replay.capacity)..rows,
                &mut indices,
            );
            for (column, &index) in indices.iter().enumerate() {
                batch.set(column, &row.read(&replay[index as usize]));
            }
            learner.update(&batch);
        }
    }
    learner.digest()
}
