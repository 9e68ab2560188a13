//! Every stage of `shoal bench` prints figures that are consistent with each other. No test asserts a duration.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use shoal_common::channel::Domain;
use shoal_common::run_dir::RunDir;
use support::output_of;
use tempfile::TempDir;

fn bench(stage: &str, temporary: &Path, seconds: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_shoal"));
    command.args(["bench", stage, "--json"]);
    command.env("SHOAL_BENCH_SECONDS", seconds).env("TMPDIR", temporary);
    command.stdin(Stdio::null());
    command
}

/// Runs a stage briefly and returns the JSON object that it prints as its only line.
fn figures(stage: &str) -> Value {
    figures_of(&[stage])
}

/// The figures of `shoal bench` with these arguments, the first of which is the stage.
fn figures_of(arguments: &[&str]) -> Value {
    let (stage, more) = arguments.split_first().unwrap();
    let temporary = TempDir::new().unwrap();
    let Output { status, stdout, stderr } = output_of(bench(stage, temporary.path(), "0.3").args(more));
    let (stdout, stderr) = (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap());
    assert!(status.success(), "{stage}: {status}: {stderr}");
    assert_eq!(stdout.lines().count(), 1, "{stdout}");
    assert!(stderr.contains('│'), "a table for the user: {stderr}");
    assert_eq!(entries(temporary.path()), 0, "{stage} leaves nothing behind");
    serde_json::from_str(&stdout).unwrap()
}

fn entries(directory: &Path) -> usize {
    std::fs::read_dir(directory).unwrap().count()
}

/// A field that must be a positive number.
fn number(figures: &Value, field: &str) -> f64 {
    let number = figures[field]
        .as_f64()
        .unwrap_or_else(|| panic!("no {field} in {figures}"));
    assert!(number.is_finite() && number > 0.0, "{field} in {figures}");
    number
}

#[test]
fn the_learner_is_compared_with_bare_matrix_products() {
    let figures = figures("learner");
    for (figures, batch, megaflop) in [(&figures, 64.0, 140.0), (&figures["large_batch"], 256.0, 560.0)] {
        let [rate, flop, limit, share] = [
            "updates_per_second",
            "flop_per_update",
            "limit_gflops",
            "share_of_limit",
        ]
        .map(|field| number(figures, field));
        assert_eq!((flop / 1e6).round(), megaflop);
        assert!((share - flop * rate / (limit * 1e9)).abs() < 1e-9 * share, "{figures}");
        assert_eq!(number(figures, "batch"), batch);
    }
    let two = &figures["two_threads"];
    let ratio = number(two, "updates_per_second") / number(&figures, "updates_per_second");
    assert!((number(two, "speedup") - ratio).abs() < 1e-9 * ratio, "{figures}");
    assert_eq!(number(&figures, "replay_rows"), 1e6);
}

#[test]
fn rows_are_written_to_the_replay_and_sampled_from_it() {
    let figures = figures("transitions");
    number(&figures, "rows_per_second");
    number(&figures, "sampled_rows_per_second");
    assert_eq!(number(&figures, "chunk_rows"), 64.0);
    let row = 4.0 * (3.0 + 1.0 + 1.0 + 1.0 + 3.0 + 1.0);
    assert_eq!(number(&figures, "row_bytes"), row);
}

#[test]
fn step_times_have_a_median_and_a_tail() {
    let figures = figures("step");
    let [least, median, p90, p99] = ["least_us", "median_us", "p90_us", "p99_us"].map(|field| number(&figures, field));
    assert!(least <= median && median <= p90 && p90 <= p99, "{figures}");
    number(&figures, "round_trips");
    number(&figures, "spin_median_us");
    assert_eq!(number(&figures, "environments"), 1.0);
    let [median, p99] = ["one_core_median_us", "one_core_p99_us"].map(|field| number(&figures, field));
    assert!(median <= p99, "{figures}");
}

#[test]
fn the_policy_acts_on_one_observation_and_on_batches() {
    let figures = figures("policy");
    for (batch, actions, time) in [
        (1.0, "actions_per_second_batch_1", "microseconds_per_call_batch_1"),
        (64.0, "actions_per_second_batch_64", "microseconds_per_call_batch_64"),
    ] {
        let product = number(&figures, actions) * number(&figures, time) / 1e6;
        assert!((product - batch).abs() < 1e-9 * batch, "{figures}");
    }
    let share = number(&figures, "reading_microseconds") / number(&figures, "microseconds_per_call_batch_1");
    assert!(
        (number(&figures, "share_of_reading") - share).abs() < 1e-9 * share,
        "{figures}"
    );
    let [flop, limit, share] = ["flop_batch_64", "limit_gflops", "share_of_limit"].map(|field| number(&figures, field));
    assert_eq!((flop / 1e5).round(), 156.0);
    let gflops = flop / number(&figures, "microseconds_per_call_batch_64") / 1e3;
    assert!((share - gflops / limit).abs() < 1e-9 * share, "{figures}");
}

#[test]
fn the_policy_of_each_algorithm_is_measured_with_its_exploration() {
    for (algorithm, inputs_and_outputs) in [("sac", 3 + 2), ("td3", 3 + 1), ("dqn", 4 + 2)] {
        let figures = figures_of(&["policy", "--method", algorithm]);
        assert_eq!(figures["method"], algorithm);
        // Presets of these algorithms have two layers of 256 units.
        let flop = 2 * 64 * (256 * 256 + 256 * inputs_and_outputs);
        assert_eq!(figures["flop_batch_64"], flop, "{figures}");
        let [time, rate, limit, share] = [
            "microseconds_per_call_exploring",
            "actions_per_second_exploring",
            "limit_gflops",
            "share_of_limit_exploring",
        ]
        .map(|field| number(&figures, field));
        assert!((time * rate / 1e6 - 64.0).abs() < 1e-9 * 64.0, "{figures}");
        assert!(
            (share - f64::from(flop) / time / 1e3 / limit).abs() < 1e-9 * share,
            "{figures}"
        );
        assert!(figures["share_of_exploration"].as_f64().unwrap() < 1.0, "{figures}");
    }
}

/// The tests above cover the stages one by one. Here all of them run, and each line's verdict follows from its number.
#[test]
fn all_stages_together_give_one_table() {
    let figures = figures("all");
    for stage in ["learner", "transitions", "step", "policy", "actors", "run"] {
        assert!(figures[stage].is_object(), "{stage} in {figures}");
    }
    let table = figures["table"].as_array().unwrap();
    assert_eq!(table.len(), 14, "{figures}");
    let line = |stage: &str| table.iter().find(|line| line["stage"] == stage).unwrap();
    let learner = line("learner, batch 64");
    let share = number(&figures["learner"], "share_of_limit");
    assert_eq!(
        (number(learner, "share"), &learner["target"]["met"]),
        (share, &Value::Bool(share >= 0.75))
    );
    let rows = number(&figures["transitions"], "rows_per_second");
    assert_eq!(line("transitions into the replay")["target"]["met"], rows >= 5e6);
    let slow = number(&figures["step"], "one_core_median_us") > 15.0;
    assert_eq!(line("environment step, one core")["target"]["met"], !slow);
    assert!(
        table
            .iter()
            .all(|line| line["ours"].as_str().is_some_and(|ours| !ours.is_empty()))
    );
}

#[test]
fn rates_of_several_actors_are_measured_and_predicted() {
    let figures = figures("actors");
    let cores = number(&figures, "cores");
    assert_eq!(number(&figures, "environments_per_actor"), 64.0);
    assert_eq!(number(&figures, "chunk_rows"), 512.0);
    let counts = figures["counts"].as_array().unwrap();
    let actors: Vec<f64> = counts.iter().map(|count| number(count, "actors")).collect();
    assert_eq!(actors[..3], [1.0, 2.0, 4.0]);
    for count in counts {
        let [actors, processes] = ["actors", "processes"].map(|field| number(count, field));
        assert_eq!(processes, 2.0 * actors + 1.0);
        assert_eq!(count["more_processes_than_cores"], processes > cores);
        for (way, updates) in [("collecting", false), ("learning", true)] {
            let [rate, one] = [&count[way], &counts[0][way]];
            // In so short a time, other work may keep the actors from sending anything.
            let rows = |rate: &Value| rate["rows_per_second"].as_f64().unwrap();
            let efficiency = rows(rate) / (actors * rows(one));
            let found = rate["efficiency"].as_f64().unwrap_or(f64::NAN);
            assert!(
                rows(one) == 0.0 || (found - efficiency).abs() < 1e-9 * efficiency.max(1.0),
                "{figures}"
            );
            number(rate, "expected_rows_per_second");
            assert!(updates || rate["updates_per_second"] == 0.0, "{figures}");
            assert_eq!(rate["expected_updates_per_second"].as_f64().unwrap() > 0.0, updates);
        }
    }
    for (way, field) in [("collecting", "rows_per_second"), ("learning", "updates_per_second")] {
        let rates = counts.iter().map(|count| count[way][field].as_f64().unwrap());
        assert!(rates.sum::<f64>() > 0.0, "{figures}");
    }
    let one_core = &figures["one_core"];
    number(one_core, "pair_rows_per_second");
    number(one_core, "inference_rows_per_second");
    let [least, share, greatest] = ["share_least", "share", "share_greatest"].map(|field| number(one_core, field));
    assert!(least <= share && share <= greatest, "{figures}");
    for stage in [
        "inference",
        "acting",
        "environment_step",
        "round_trip",
        "writing_chunk",
        "intake_of_chunk",
        "update",
    ] {
        number(&figures["costs"], &format!("{stage}_us"));
    }
    let scaling = figures["scaling"].as_array().unwrap();
    let predicted: Vec<f64> = scaling.iter().map(|one| number(one, "actors")).collect();
    assert_eq!(predicted, [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 64.0]);
    for pair in scaling.windows(2) {
        let [few, many] = [0, 1].map(|i| number(&pair[i], "rows_per_second"));
        // From the first bottleneck on there are as many rows, except for rounding.
        assert!(few <= many * (1.0 + 1e-9), "more actors, no fewer rows: {figures}");
        let [few, many] = [0, 1].map(|i| number(&pair[i], "efficiency"));
        assert!(many < few + 1e-6, "{figures}");
    }
    for which in [
        "first_bottleneck",
        "first_bottleneck_with_updates",
        "first_bottleneck_on_these_cores",
    ] {
        assert!(figures[which]["resource"].is_string());
        number(&figures[which], "actors");
    }
}

#[test]
fn the_run_stage_measures_starts_recoveries_and_memory() {
    let figures = figures("run");
    assert!(number(&figures, "starts") >= 1.0 && number(&figures, "kills") >= 1.0);
    assert_eq!(number(&figures, "warm_up_rows"), 1000.0);
    let time = |field: &str| {
        let [median, worst] = ["median", "worst"].map(|which| number(&figures[field], which));
        assert!(median <= worst, "{figures}");
        median
    };
    assert!(time("start_seconds") >= time("first_update_seconds"));
    assert!(time("recovery_seconds") >= time("successor_ready_seconds"));
    time("ready_seconds");
    time("warm_up_seconds");
    let roles = figures["roles"].as_array().unwrap();
    let named = |name| roles.iter().filter(|role| role["role"] == name).count();
    assert_eq!(["learner", "evaluator", "actor", "env-server"].map(named), [1, 1, 2, 3]);
    for role in roles {
        for bytes in [
            "private_bytes",
            "proportional_bytes",
            "shared_memory_bytes",
            "file_bytes",
        ] {
            number(role, bytes);
        }
        let has_replay = role["replay_bytes"].as_u64().unwrap() > 20_000;
        assert!(has_replay || role["role"] != "learner", "{figures}");
    }
}

#[test]
fn an_invalid_list_of_counts_is_refused_in_one_line() {
    let temporary = TempDir::new().unwrap();
    for (stage, counts) in [
        ("actors", ""),
        ("actors", "0"),
        ("actors", "1,,2"),
        ("actors", "two"),
        ("actors", "-1"),
        ("actors", "1025"),
        ("policy", "1,2"),
    ] {
        let mut command = bench(stage, temporary.path(), "0.3");
        let output = output_of(command.args(["--actors", counts]));
        assert!(
            !output.status.success() && output.stdout.is_empty(),
            "{stage} {counts:?}"
        );
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(
            message.contains("--actors") && message.lines().count() == 1,
            "{message}"
        );
        assert_eq!(entries(temporary.path()), 0);
    }
}

#[test]
fn an_interrupted_stage_leaves_nothing_behind() {
    for stage in ["transitions", "step", "actors", "run"] {
        let temporary = TempDir::new().unwrap();
        let mut child = bench(stage, temporary.path(), "60")
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let shared = eventually(stage, || {
            let directory = std::fs::read_dir(temporary.path()).unwrap().next()?.unwrap();
            let config = std::fs::read_to_string(directory.path().join("run/config.toml")).ok()?;
            let id = config
                .lines()
                .find_map(|line| line.strip_prefix("id = ")?.split('"').nth(1))?;
            let prefix = format!("shoal_{id}_");
            (shared_files(&prefix) > 0).then_some(prefix)
        });
        kill_process(Pid::from_child(&child), Signal::INT).unwrap();
        let status = eventually(stage, || child.try_wait().unwrap());
        assert_eq!(status.code(), Some(1), "{stage}");
        let mut message = String::new();
        std::io::Read::read_to_string(&mut child.stderr.take().unwrap(), &mut message).unwrap();
        assert_eq!(message, "error: interrupted\n", "{stage}");
        assert_eq!(entries(temporary.path()), 0, "{stage}");
        assert_eq!(shared_files(&shared), 0, "{stage}");
    }
}

#[test]
fn the_training_of_a_killed_stage_ends() {
    let temporary = TempDir::new().unwrap();
    let mut child = bench("run", temporary.path(), "60")
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    let run = eventually("run", || {
        let directory = std::fs::read_dir(temporary.path()).unwrap().next()?.unwrap();
        let run = RunDir::open(&directory.path().join("run")).ok()?;
        let begun = run.incarnations().exists() && run.is_running().unwrap();
        begun.then_some(run)
    });
    let prefix = format!("shoal_{}_", run.config().unwrap().run.id);
    child.kill().unwrap();
    child.wait().unwrap();
    eventually("run", || (!run.is_running().unwrap()).then_some(()));
    eventually("run", || {
        Domain::remove_abandoned().unwrap();
        (shared_files(&prefix) == 0).then_some(())
    });
}

#[test]
fn an_invalid_duration_is_refused_in_one_line() {
    let temporary = TempDir::new().unwrap();
    for seconds in ["soon", "0", "-1", "nan"] {
        let output = output_of(&mut bench("policy", temporary.path(), seconds));
        assert!(!output.status.success() && output.stdout.is_empty());
        let message = String::from_utf8(output.stderr).unwrap();
        assert!(
            message.contains("SHOAL_BENCH_SECONDS") && message.lines().count() == 1,
            "{message}"
        );
    }
}

fn shared_files(prefix: &str) -> usize {
    let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
    files
        .filter(|file| file.file_name().to_string_lossy().starts_with(prefix))
        .count()
}

/// Polls until `look` returns something. Only a stage that hangs reaches the deadline.
fn eventually<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + Duration::from_secs(120);
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < deadline, "bench {stage} hangs", stage = what);
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// The network is not built by default.
#[cfg(not(feature = "remote"))]
#[test]
fn without_the_network_each_command_that_needs_it_says_how_to_build_it() {
    let temporary = TempDir::new().unwrap();
    let commands: [&[&str]; 3] = [
        &["bench", "remote"],
        &["join", "tcp/127.0.0.1:1", "--actors", "1"],
        &["train", "pendulum", "--listen"],
    ];
    for arguments in commands {
        let mut command = Command::new(env!("CARGO_BIN_EXE_shoal"));
        let output = output_of(command.args(arguments).current_dir(temporary.path()));
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(!output.status.success(), "{arguments:?}");
        assert_eq!(said.lines().count(), 1, "{said}");
        assert!(said.contains("--features remote"), "{said}");
    }
}
