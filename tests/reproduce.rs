//! `shoal reproduce` resumes what was interrupted, does not repeat what is finished, and refuses files that are not its
//! own.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use rustix::process::{Pid, Signal, kill_process};
use shoal_common::run_dir::RunDir;
use support::{Leftovers, Workplace, error_line, until};

/// A running `shoal reproduce`; ended when dropped.
struct Reproduction(Child);

impl Reproduction {
    fn start(place: &Workplace, arguments: &[&str]) -> Self {
        Self::start_command(place, &mut place.shoal(arguments))
    }

    fn start_command(place: &Workplace, command: &mut Command) -> Self {
        let stderr = std::fs::File::create(place.path().join("stderr")).unwrap();
        Self(command.stdout(Stdio::null()).stderr(stderr).spawn().unwrap())
    }

    fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.0), signal).unwrap();
    }

    fn wait(mut self) -> ExitStatus {
        until("the command has ended", || self.0.try_wait().unwrap().is_some());
        self.0.wait().unwrap()
    }
}

impl Drop for Reproduction {
    fn drop(&mut self) {
        // By SIGTERM, so that its training ends too.
        if self.0.try_wait().unwrap().is_none() {
            self.signal(Signal::TERM);
            let _ = self.0.wait();
        }
    }
}

const PENDULUM: [&str; 7] = ["reproduce", "pendulum", "--quick", "--jobs", "1", "--out", "kept"];

fn log(run: &Path) -> String {
    std::fs::read_to_string(run.join("shoal.log")).unwrap_or_default()
}

/// How many times a run was started.
fn starts(run: &Path) -> usize {
    log(run).matches("every role is ready").count()
}

fn runs(place: &Workplace) -> [PathBuf; 2] {
    ["seed-1", "seed-2"].map(|seed| place.path().join("kept/pendulum").join(seed))
}

/// The lines of an experiment's results file: a header, then one result per line.
fn lines(results: &Path) -> Vec<String> {
    lines_of(&std::fs::read(results).unwrap())
}

fn lines_of(bytes: &[u8]) -> Vec<String> {
    let mut text = String::new();
    GzDecoder::new(bytes).read_to_string(&mut text).unwrap();
    text.lines().map(Into::into).collect()
}

/// The seeds and stages whose results are in the file.
fn seeds_and_stages(results: &Path) -> Vec<(u64, String)> {
    let of = |line: &String| {
        let result: serde_json::Value = serde_json::from_str(line).unwrap();
        (
            result["seed"].as_u64().unwrap(),
            result["stage"].as_str().unwrap().into(),
        )
    };
    lines(results)[1..].iter().map(of).collect()
}

/// Puts every result of the first stage into a file of its own, as earlier versions did, and removes the results file.
fn convert_to_old_format(results: &Path, directory: &Path) {
    std::fs::create_dir_all(directory).unwrap();
    for ((seed, _), line) in seeds_and_stages(results).iter().zip(&lines(results)[1..]) {
        let old = line.replacen("\"stage\":\"\",", "", 1) + "\n";
        std::fs::write(directory.join(format!("seed-{seed}.json")), old).unwrap();
    }
    std::fs::remove_file(results).unwrap();
}

#[test]
fn an_interrupted_reproduction_continues_and_repeats_no_training() {
    let place = Workplace::new();
    let [first, second] = runs(&place);
    let results = place.path().join("kept/pendulum.jsonl.gz");
    let seeds = |seeds: &[u64]| seeds.iter().map(|seed| (*seed, String::new())).collect::<Vec<_>>();

    // As with `nohup`: neither it nor its trainings may end with their terminal.
    let reproduction = Reproduction::start_command(&place, &mut place.shoal_ignoring("HUP", &PENDULUM));
    until("the first seed trains", || starts(&first) == 1);
    reproduction.signal(Signal::HUP);
    until("the second seed trains", || starts(&second) == 1);
    let meanwhile = error_line(&place.output(&PENDULUM));
    assert!(meanwhile.contains("another `shoal reproduce`"), "{meanwhile}");
    reproduction.signal(Signal::INT);
    assert_eq!(reproduction.wait().code(), Some(130), "{}", place.stderr());
    assert_eq!(seeds_and_stages(&results), seeds(&[1]));
    assert!(
        log(&second).contains("signal 2 (SIGINT) ends the run"),
        "{}",
        log(&second)
    );
    Leftovers::of(&second).wait_until_gone();
    let report = || std::fs::read_to_string(place.path().join("kept/REPORT.md")).unwrap();
    assert!(report().contains("seeds 1; missing: 2"), "{}", report());

    assert!(
        Reproduction::start(&place, &PENDULUM).wait().success(),
        "{}",
        place.stderr()
    );
    assert_eq!((starts(&first), starts(&second)), (1, 2), "{}", place.stderr());
    assert!(
        report().contains("seeds 1, 2\n") && report().contains("quick look"),
        "{}",
        report()
    );
    let figure = |file: &str| place.path().join("kept/figures").join(file);
    for name in ["pendulum-learning-curve", "pendulum-swing-up"] {
        assert!(
            std::fs::read(figure(&format!("{name}.svg")))
                .unwrap()
                .starts_with(b"<svg")
        );
        assert!(
            !figure(&format!("{name}.png")).exists(),
            "PNG figures were not requested"
        );
    }

    // The results alone are enough for the report, in any directory.
    assert_eq!(seeds_and_stages(&results), seeds(&[1, 2]));
    let bytes = std::fs::read(&results).unwrap();
    for run in [&first, &second] {
        std::fs::remove_dir_all(run).unwrap();
    }
    let elsewhere = [&PENDULUM[..], &["--report", "elsewhere/REPORT.md", "--png"]].concat();
    assert!(
        Reproduction::start(&place, &elsewhere).wait().success(),
        "{}",
        place.stderr()
    );
    assert!(!first.exists() && !second.exists(), "nothing was trained");
    let other_report = std::fs::read_to_string(place.path().join("elsewhere/REPORT.md")).unwrap();
    for link in [
        "![The swing-up",
        "](../kept/figures/pendulum-swing-up.svg)",
        "([PNG](../kept/figures/pendulum-swing-up.png))",
    ] {
        assert!(other_report.contains(link), "{link}: {other_report}");
    }
    assert!(
        std::fs::read(figure("pendulum-swing-up.png"))
            .unwrap()
            .starts_with(b"\x89PNG")
    );

    // In lockstep a seed's result is the same, interrupted or not.
    let mut shortened = GzEncoder::new(File::create(&results).unwrap(), Compression::fast());
    for line in &lines_of(&bytes)[..2] {
        writeln!(shortened, "{line}").unwrap();
    }
    shortened.finish().unwrap();
    assert_eq!(seeds_and_stages(&results), seeds(&[1]));
    assert!(
        Reproduction::start(&place, &PENDULUM).wait().success(),
        "{}",
        place.stderr()
    );
    assert!(!first.exists() && starts(&second) == 1);
    assert_eq!(lines(&results), lines_of(&bytes));
    assert!(
        std::fs::read(&results).unwrap() == bytes,
        "the same results are the same bytes"
    );

    // Results of earlier versions count, and are moved into the new file.
    convert_to_old_format(&results, first.parent().unwrap());
    assert!(
        Reproduction::start(&place, &PENDULUM).wait().success(),
        "{}",
        place.stderr()
    );
    assert!(!first.exists() && starts(&second) == 1, "nothing was trained");
    assert_eq!(lines(&results), lines_of(&bytes));
    assert!(!place.path().join("kept/pendulum/seed-1.json").exists() && report().contains("seeds 1, 2\n"));
}

#[test]
fn a_failed_seed_is_reported_missing_and_the_others_continue() {
    let place = Workplace::new();
    let [first, second] = runs(&place);
    std::fs::create_dir_all(&first).unwrap();
    std::fs::write(first.join("notes.txt"), "mine").unwrap();
    assert_eq!(Reproduction::start(&place, &PENDULUM).wait().code(), Some(1));
    assert!(
        place.stderr().contains("pendulum seed 1: failed: "),
        "{}",
        place.stderr()
    );
    let report = std::fs::read_to_string(place.path().join("kept/REPORT.md")).unwrap();
    assert!(
        report.contains("seeds 2; missing: 1; seed 1 failed: pendulum/seed-1 is not"),
        "{report}"
    );
    assert_eq!(std::fs::read_to_string(first.join("notes.txt")).unwrap(), "mine");
    assert_eq!(starts(&second), 1);

    // Results made with other settings are neither used nor overwritten, in either format.
    let results = place.path().join("kept/pendulum.jsonl.gz");
    let bytes = std::fs::read(&results).unwrap();
    let full = ["reproduce", "pendulum", "--out", "kept"];
    let refused = error_line(&place.output(&full));
    assert!(
        refused.contains("pendulum.jsonl.gz (seed 2)") && refused.contains("--out"),
        "{refused}"
    );
    assert_eq!(std::fs::read(&results).unwrap(), bytes);
    convert_to_old_format(&results, first.parent().unwrap());
    let refused = error_line(&place.output(&full));
    assert!(
        refused.contains("pendulum/seed-2.json") && refused.contains("--out"),
        "{refused}"
    );
    assert!(place.path().join("kept/pendulum/seed-2.json").exists() && !results.exists());
}

/// A seed that trains for minutes.
const LONG: [&str; 8] = ["reproduce", "pendulum", "--seeds", "1", "--jobs", "1", "--out", "kept"];

#[test]
fn a_seed_that_was_stopped_has_no_result() {
    let place = Workplace::new();
    let [first, _] = runs(&place);
    let reproduction = Reproduction::start(&place, &LONG);
    until("the seed trains", || starts(&first) == 1);
    assert!(place.output(&["stop", first.to_str().unwrap()]).status.success());
    assert_eq!(reproduction.wait().code(), Some(1), "{}", place.stderr());
    let failed = "pendulum seed 1: failed: it was stopped before its end";
    assert!(place.stderr().contains(failed), "{}", place.stderr());
    assert!(!place.path().join("kept/pendulum.jsonl.gz").exists());
}

#[test]
fn the_trainings_of_a_killed_reproduction_end_and_the_same_command_continues_them() {
    let place = Workplace::new();
    let [first, _] = runs(&place);
    let reproduction = Reproduction::start(&place, &LONG);
    until("the seed trains", || starts(&first) == 1);
    reproduction.signal(Signal::KILL);
    reproduction.wait();
    until("its training has ended", || {
        !RunDir::open(&first).unwrap().is_running().unwrap()
    });
    assert!(!first.join("checkpoints/last.policy").exists(), "{}", log(&first));
    let reproduction = Reproduction::start(&place, &LONG);
    until("it goes on", || starts(&first) == 2);
    reproduction.signal(Signal::INT);
    assert_eq!(reproduction.wait().code(), Some(130), "{}", place.stderr());
    Leftovers::of(&first).wait_until_gone();
}

#[test]
fn every_experiment_of_the_thesis_runs_with_quick() {
    let place = Workplace::new();
    let all = [
        "reproduce",
        "all",
        "--quick",
        "--seeds",
        "1",
        "--jobs",
        "2",
        "--out",
        "kept",
    ];
    assert!(Reproduction::start(&place, &all).wait().success(), "{}", place.stderr());
    let report = std::fs::read_to_string(place.path().join("kept/REPORT.md")).unwrap();
    assert!(!report.contains("missing"), "{report}");
    for (figure, of_the_thesis) in [
        ("frozen-lake-epsilon-reward", "4.2a"),
        ("frozen-lake-alpha-steps", "4.3b"),
        ("frozen-lake-policy", "4.4"),
        ("cart-pole-seeds", "4.6"),
        ("pendulum-learning-curve", "4.8"),
        ("pendulum-swing-up", "4.9"),
        ("point-mass-r1-test-runs", "5.5"),
        ("point-mass-r2-learning-curve", "5.6"),
        ("point-mass-r3-test-runs", "5.9"),
        ("point-mass-paths", "5.10"),
        ("point-mass-actions", "5.11"),
        ("point-mass-r2-longer-learning-curve", "A.3"),
        ("point-mass-r3-far-2", "A.8"),
    ] {
        let line = report.lines().find(|line| line.contains(&format!("{figure}.svg")));
        assert!(
            line.is_some_and(|line| line.contains(of_the_thesis)),
            "{figure}: {report}"
        );
        assert!(
            place.path().join(format!("kept/figures/{figure}.svg")).exists(),
            "{figure}"
        );
    }
    // The result for the lake holds every evaluated policy and the final table.
    let evaluated = place.path().join("kept/frozen-lake/seed-1/policies");
    let evaluated = std::fs::read_dir(evaluated).unwrap().count();
    let result = &lines(&place.path().join("kept/frozen-lake.jsonl.gz"))[1];
    let result: serde_json::Value = serde_json::from_str(result).unwrap();
    assert!(evaluated > 1, "{evaluated}");
    assert_eq!(result["tests"]["judged"].as_array().unwrap().len(), evaluated);
    assert_eq!(result["tests"]["q"].as_array().unwrap().len(), 64);
    // Each experiment has one file, with all its stages.
    let stages = ["", "-longer"].map(|stage| (1, stage.to_string()));
    assert_eq!(
        seeds_and_stages(&place.path().join("kept/point-mass-r2.jsonl.gz")),
        stages
    );
}
