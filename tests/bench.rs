//! `shoal bench`: every stage answers, and what it says hangs together. No time is asserted.

#![allow(clippy::unwrap_used, reason = "a failure anywhere in here is a failed test")]

use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, Signal, kill_process};
use serde_json::Value;
use tempfile::TempDir;

fn bench(stage: &str, temporary: &Path, seconds: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_shoal"));
    command.args(["bench", stage, "--json"]);
    command.env("SHOAL_BENCH_SECONDS", seconds).env("TMPDIR", temporary);
    command.stdin(Stdio::null());
    command
}

/// Runs a stage for a moment: the JSON object that is the one line of its standard output.
fn figures(stage: &str) -> Value {
    let temporary = TempDir::new().unwrap();
    let Output { status, stdout, stderr } = bench(stage, temporary.path(), "0.3").output().unwrap();
    let (stdout, stderr) = (String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap());
    assert!(status.success(), "{stage}: {status}: {stderr}");
    assert_eq!(stdout.lines().count(), 1, "{stdout}");
    assert!(stderr.contains('│'), "a table for people: {stderr}");
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
fn the_learner_is_held_against_the_matrix_products() {
    let figures = figures("learner");
    let [rate, flop, limit, share] = [
        "updates_per_second",
        "flop_per_update",
        "limit_gflops",
        "share_of_limit",
    ]
    .map(|field| number(&figures, field));
    assert_eq!((flop / 1e6).round(), 140.0);
    assert!((share - flop * rate / (limit * 1e9)).abs() < 1e-9 * share, "{figures}");
    assert_eq!(number(&figures, "batch"), 64.0);
    assert_eq!(number(&figures, "replay_rows"), 1e6);
}

#[test]
fn rows_reach_the_replay_and_come_out_again() {
    let figures = figures("transitions");
    number(&figures, "rows_per_second");
    number(&figures, "sampled_rows_per_second");
    assert_eq!(number(&figures, "chunk_rows"), 64.0);
    let row = 4.0 * (3.0 + 1.0 + 1.0 + 1.0 + 3.0 + 1.0);
    assert_eq!(number(&figures, "row_bytes"), row);
}

#[test]
fn a_step_has_its_median_and_its_tail() {
    let figures = figures("step");
    let [least, median, p90, p99] = ["least_us", "median_us", "p90_us", "p99_us"].map(|field| number(&figures, field));
    assert!(least <= median && median <= p90 && p90 <= p99, "{figures}");
    number(&figures, "round_trips");
    number(&figures, "spin_median_us");
    assert_eq!(number(&figures, "environments"), 1.0);
}

#[test]
fn the_policy_acts_alone_and_in_batches() {
    let figures = figures("policy");
    for (batch, actions, time) in [
        (1.0, "actions_per_second_batch_1", "microseconds_per_call_batch_1"),
        (64.0, "actions_per_second_batch_64", "microseconds_per_call_batch_64"),
    ] {
        let product = number(&figures, actions) * number(&figures, time) / 1e6;
        assert!((product - batch).abs() < 1e-9 * batch, "{figures}");
    }
}

#[test]
fn interrupted_it_leaves_nothing_behind() {
    for stage in ["transitions", "step"] {
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
        let mut said = String::new();
        std::io::Read::read_to_string(&mut child.stderr.take().unwrap(), &mut said).unwrap();
        assert_eq!(said, "error: interrupted\n", "{stage}");
        assert_eq!(entries(temporary.path()), 0, "{stage}");
        assert_eq!(shared_files(&shared), 0, "{stage}");
    }
}

#[test]
fn a_time_that_is_none_is_refused_in_one_line() {
    let temporary = TempDir::new().unwrap();
    for seconds in ["soon", "0", "-1", "nan"] {
        let output = bench("policy", temporary.path(), seconds).output().unwrap();
        assert!(!output.status.success() && output.stdout.is_empty());
        let said = String::from_utf8(output.stderr).unwrap();
        assert!(
            said.contains("SHOAL_BENCH_SECONDS") && said.lines().count() == 1,
            "{said}"
        );
    }
}

fn shared_files(prefix: &str) -> usize {
    let files = std::fs::read_dir("/dev/shm").unwrap().flatten();
    files
        .filter(|file| file.file_name().to_string_lossy().starts_with(prefix))
        .count()
}

/// Looks until there is something. Nothing takes this long unless it hangs.
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
