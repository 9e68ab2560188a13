//! `shoal reproduce`: what is interrupted goes on, what is there is not run again, and what is not ours is refused.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::fs::File;
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus, Stdio};

use flate2::Compression;
use flate2::read::GzDecoder;
use flate2::write::GzEncoder;
use rustix::process::{Pid, Signal, kill_process};
use support::{Leftovers, Workplace, complaint, until};

/// The command under way; ended when dropped.
struct Reproducing(Child);

impl Reproducing {
    fn start(place: &Workplace, arguments: &[&str]) -> Self {
        let stderr = std::fs::File::create(place.path().join("stderr")).unwrap();
        let mut command = place.shoal(arguments);
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

impl Drop for Reproducing {
    fn drop(&mut self) {
        // In order, so that its training ends too.
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

/// How often a run was started.
fn starts(run: &Path) -> usize {
    log(run).matches("every role is ready").count()
}

fn runs(place: &Workplace) -> [PathBuf; 2] {
    ["seed-1", "seed-2"].map(|seed| place.path().join("kept/pendulum").join(seed))
}

/// The lines of an experiment's results: its head, then a result in each.
fn lines(results: &Path) -> Vec<String> {
    lines_of(&std::fs::read(results).unwrap())
}

fn lines_of(bytes: &[u8]) -> Vec<String> {
    let mut text = String::new();
    GzDecoder::new(bytes).read_to_string(&mut text).unwrap();
    text.lines().map(Into::into).collect()
}

/// The seeds and stages whose results are there.
fn kept(results: &Path) -> Vec<(u64, String)> {
    let of = |line: &String| {
        let result: serde_json::Value = serde_json::from_str(line).unwrap();
        (
            result["seed"].as_u64().unwrap(),
            result["stage"].as_str().unwrap().into(),
        )
    };
    lines(results)[1..].iter().map(of).collect()
}

/// Puts every result of the first stage into a file of its own, as earlier versions did, and removes the one file.
fn as_before(results: &Path, directory: &Path) {
    std::fs::create_dir_all(directory).unwrap();
    for ((seed, _), line) in kept(results).iter().zip(&lines(results)[1..]) {
        let old = line.replacen("\"stage\":\"\",", "", 1) + "\n";
        std::fs::write(directory.join(format!("seed-{seed}.json")), old).unwrap();
    }
    std::fs::remove_file(results).unwrap();
}

#[test]
fn what_is_interrupted_goes_on_and_nothing_is_run_twice() {
    let place = Workplace::new();
    let [first, second] = runs(&place);
    let results = place.path().join("kept/pendulum.jsonl.gz");
    let seeds = |seeds: &[u64]| seeds.iter().map(|seed| (*seed, String::new())).collect::<Vec<_>>();

    let reproducing = Reproducing::start(&place, &PENDULUM);
    until("the second seed trains", || starts(&second) == 1);
    let meanwhile = complaint(&place.output(&PENDULUM));
    assert!(meanwhile.contains("another `shoal reproduce`"), "{meanwhile}");
    reproducing.signal(Signal::INT);
    assert_eq!(reproducing.wait().code(), Some(130), "{}", place.said());
    assert_eq!(kept(&results), seeds(&[1]));
    Leftovers::of(&second).vanish();
    let report = || std::fs::read_to_string(place.path().join("kept/REPORT.md")).unwrap();
    assert!(report().contains("seeds 1; missing: 2"), "{}", report());

    assert!(
        Reproducing::start(&place, &PENDULUM).wait().success(),
        "{}",
        place.said()
    );
    assert_eq!((starts(&first), starts(&second)), (1, 2), "{}", place.said());
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
        assert!(!figure(&format!("{name}.png")).exists(), "nobody asked for it");
    }

    // Results alone are enough for the report, wherever it goes.
    assert_eq!(kept(&results), seeds(&[1, 2]));
    let bytes = std::fs::read(&results).unwrap();
    for run in [&first, &second] {
        std::fs::remove_dir_all(run).unwrap();
    }
    let elsewhere = [&PENDULUM[..], &["--report", "told/REPORT.md", "--png"]].concat();
    assert!(
        Reproducing::start(&place, &elsewhere).wait().success(),
        "{}",
        place.said()
    );
    assert!(!first.exists() && !second.exists(), "nothing was due");
    let told = std::fs::read_to_string(place.path().join("told/REPORT.md")).unwrap();
    for link in [
        "![The swing-up",
        "](../kept/figures/pendulum-swing-up.svg)",
        "([PNG](../kept/figures/pendulum-swing-up.png))",
    ] {
        assert!(told.contains(link), "{link}: {told}");
    }
    assert!(
        std::fs::read(figure("pendulum-swing-up.png"))
            .unwrap()
            .starts_with(b"\x89PNG")
    );

    // In lockstep a seed's result is the same, interrupted or not.
    let mut without = GzEncoder::new(File::create(&results).unwrap(), Compression::fast());
    for line in &lines_of(&bytes)[..2] {
        writeln!(without, "{line}").unwrap();
    }
    without.finish().unwrap();
    assert_eq!(kept(&results), seeds(&[1]));
    assert!(
        Reproducing::start(&place, &PENDULUM).wait().success(),
        "{}",
        place.said()
    );
    assert!(!first.exists() && starts(&second) == 1);
    assert_eq!(lines(&results), lines_of(&bytes));
    assert!(
        std::fs::read(&results).unwrap() == bytes,
        "the same results are the same bytes"
    );

    // What earlier versions kept counts, and is taken over.
    as_before(&results, first.parent().unwrap());
    assert!(
        Reproducing::start(&place, &PENDULUM).wait().success(),
        "{}",
        place.said()
    );
    assert!(!first.exists() && starts(&second) == 1, "nothing was due");
    assert_eq!(lines(&results), lines_of(&bytes));
    assert!(!place.path().join("kept/pendulum/seed-1.json").exists() && report().contains("seeds 1, 2\n"));
}

#[test]
fn a_seed_that_fails_is_missing_and_the_others_go_on() {
    let place = Workplace::new();
    let [first, second] = runs(&place);
    std::fs::create_dir_all(&first).unwrap();
    std::fs::write(first.join("notes.txt"), "mine").unwrap();
    assert_eq!(Reproducing::start(&place, &PENDULUM).wait().code(), Some(1));
    assert!(place.said().contains("pendulum seed 1: failed: "), "{}", place.said());
    let report = std::fs::read_to_string(place.path().join("kept/REPORT.md")).unwrap();
    assert!(
        report.contains("seeds 2; missing: 1; seed 1 failed: pendulum/seed-1 is not"),
        "{report}"
    );
    assert_eq!(std::fs::read_to_string(first.join("notes.txt")).unwrap(), "mine");
    assert_eq!(starts(&second), 1);

    // What was made otherwise is neither used nor overwritten, in whichever form it is.
    let results = place.path().join("kept/pendulum.jsonl.gz");
    let bytes = std::fs::read(&results).unwrap();
    let full = ["reproduce", "pendulum", "--out", "kept"];
    let refused = complaint(&place.output(&full));
    assert!(
        refused.contains("pendulum.jsonl.gz (seed 2)") && refused.contains("--out"),
        "{refused}"
    );
    assert_eq!(std::fs::read(&results).unwrap(), bytes);
    as_before(&results, first.parent().unwrap());
    let refused = complaint(&place.output(&full));
    assert!(
        refused.contains("pendulum/seed-2.json") && refused.contains("--out"),
        "{refused}"
    );
    assert!(place.path().join("kept/pendulum/seed-2.json").exists() && !results.exists());
}

#[test]
fn every_experiment_of_the_thesis_can_be_glanced_at() {
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
    assert!(Reproducing::start(&place, &all).wait().success(), "{}", place.said());
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
    // Every policy that was evaluated on the lake is there, and the table at the end.
    let evaluated = place.path().join("kept/frozen-lake/seed-1/policies");
    let evaluated = std::fs::read_dir(evaluated).unwrap().count();
    let result = &lines(&place.path().join("kept/frozen-lake.jsonl.gz"))[1];
    let result: serde_json::Value = serde_json::from_str(result).unwrap();
    assert!(evaluated > 1, "{evaluated}");
    assert_eq!(result["tests"]["judged"].as_array().unwrap().len(), evaluated);
    assert_eq!(result["tests"]["q"].as_array().unwrap().len(), 64);
    // Each experiment has one file, with all its stages.
    let stages = ["", "-longer"].map(|stage| (1, stage.to_string()));
    assert_eq!(kept(&place.path().join("kept/point-mass-r2.jsonl.gz")), stages);
}
