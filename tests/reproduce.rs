//! `shoal reproduce`: what is interrupted goes on, what is there is not run again, and what is not ours is refused.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod support;

use std::path::{Path, PathBuf};
use std::process::{Child, ExitStatus, Stdio};

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

#[test]
fn what_is_interrupted_goes_on_and_nothing_is_run_twice() {
    let place = Workplace::new();
    let [first, second] = runs(&place);
    let result = place.path().join("kept/pendulum/seed-2.json");

    let reproducing = Reproducing::start(&place, &PENDULUM);
    until("the second seed trains", || starts(&second) == 1);
    let meanwhile = complaint(&place.output(&PENDULUM));
    assert!(meanwhile.contains("another `shoal reproduce`"), "{meanwhile}");
    reproducing.signal(Signal::INT);
    assert_eq!(reproducing.wait().code(), Some(130), "{}", place.said());
    assert!(place.path().join("kept/pendulum/seed-1.json").exists() && !result.exists());
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
    for figure in ["pendulum-learning-curve", "pendulum-swing-up"] {
        for (ending, magic) in [("svg", &b"<svg"[..]), ("png", b"\x89PNG")] {
            let bytes = std::fs::read(place.path().join(format!("kept/figures/{figure}.{ending}"))).unwrap();
            assert!(bytes.starts_with(magic), "{figure}.{ending}");
        }
    }

    // Results alone are enough for the report, wherever it goes.
    let kept = std::fs::read(&result).unwrap();
    for run in [&first, &second] {
        std::fs::remove_dir_all(run).unwrap();
    }
    let elsewhere = [&PENDULUM[..], &["--report", "told/REPORT.md"]].concat();
    assert!(
        Reproducing::start(&place, &elsewhere).wait().success(),
        "{}",
        place.said()
    );
    assert!(!first.exists() && !second.exists(), "nothing was due");
    let told = std::fs::read_to_string(place.path().join("told/REPORT.md")).unwrap();
    assert!(told.contains("(../kept/figures/pendulum-swing-up.png)"), "{told}");

    // In lockstep a seed's result is the same, interrupted or not.
    std::fs::remove_file(&result).unwrap();
    assert!(
        Reproducing::start(&place, &PENDULUM).wait().success(),
        "{}",
        place.said()
    );
    assert_eq!(starts(&second), 1);
    assert_eq!(
        String::from_utf8(std::fs::read(&result).unwrap()),
        String::from_utf8(kept)
    );
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

    // What was made otherwise is neither used nor overwritten.
    let result = place.path().join("kept/pendulum/seed-2.json");
    let kept = std::fs::read(&result).unwrap();
    let full = ["reproduce", "pendulum", "--out", "kept"];
    let refused = complaint(&place.output(&full));
    assert!(
        refused.contains("seed-2.json") && refused.contains("--out"),
        "{refused}"
    );
    assert_eq!(std::fs::read(&result).unwrap(), kept);
}
