//! Processes that are killed at each step of saving. The children are this binary again.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};

use rustix::process::{Signal, getpid, kill_process};
use shoal_learner::process::checkpoint::{Checkpoint, Checkpoints, Counters, SaveStep};
use tempfile::TempDir;

const DIRECTORY: &str = "SHOAL_TEST_DIRECTORY";
/// The step after which the child is killed.
const STEP: &str = "SHOAL_TEST_STEP";
/// The updates of the newest published checkpoint; 0 before the first.
const NEWEST: &str = "SHOAL_TEST_NEWEST";
/// The updates of the child's checkpoint.
const NEXT: &str = "SHOAL_TEST_NEXT";

const STEPS: [SaveStep; 3] = [SaveStep::Prepared, SaveStep::Kept, SaveStep::Published];

fn counters(updates: u64) -> Counters {
    Counters {
        updates,
        rows: 3 * updates,
        episodes: 0,
        policy_version: updates + 1,
    }
}

fn number(name: &str) -> u64 {
    std::env::var(name).unwrap().parse().unwrap()
}

/// Loads, and asserts that the result is the newest published checkpoint.
fn load(directory: &Path, newest: u64) -> (Checkpoints, Vec<String>) {
    let mut store = Checkpoints::new(directory, 7);
    let warnings = match store.load_newest().unwrap() {
        None => {
            assert_eq!(newest, 0, "a published checkpoint was not found");
            vec![]
        }
        Some(loaded) => {
            let Checkpoint {
                counters: found,
                arrays,
            } = loaded.checkpoint;
            assert_eq!(found, counters(newest));
            assert_eq!(arrays, [("actor".to_owned(), vec![newest as f32; 3000])]);
            loaded.warnings
        }
    };
    (store, warnings)
}

#[test]
#[ignore = "a child of the tests below"]
fn child_saves() {
    // The user may run the ignored tests by hand.
    let Some(directory) = std::env::var_os(DIRECTORY).map(PathBuf::from) else {
        return;
    };
    let (mut store, _) = load(&directory, number(NEWEST));
    store.on_step(|step| {
        if std::env::var(STEP).is_ok_and(|name| name == format!("{step:?}")) {
            kill_process(getpid(), Signal::KILL).unwrap();
        }
    });
    let next = number(NEXT);
    store
        .save(&counters(next), &[("actor", &vec![next as f32; 3000])])
        .unwrap();
}

/// Runs a process that loads checkpoint `newest` and saves `next`, and is killed after `step`.
fn saves(directory: &Path, newest: u64, next: u64, step: Option<SaveStep>) -> ExitStatus {
    Command::new(std::env::current_exe().unwrap())
        .args(["kills::child_saves", "--exact", "--ignored"])
        .env(DIRECTORY, directory)
        .env(NEWEST, newest.to_string())
        .env(NEXT, next.to_string())
        .env(STEP, step.map_or_else(String::new, |step| format!("{step:?}")))
        .stdout(Stdio::null())
        .status()
        .unwrap()
}

fn names(directory: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(directory).unwrap();
    entries
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect()
}

/// Processes save one after another, and each is killed after some step. The next one always continues from the newest
/// published checkpoint.
#[test]
fn a_learner_killed_at_any_step_of_any_save_continues_from_the_newest_checkpoint() {
    for first in STEPS {
        for second in STEPS {
            for third in STEPS {
                let directory = TempDir::new().unwrap();
                let (mut newest, mut before) = (0, 0);
                for (next, step) in (1..).zip([first, second, third]) {
                    let status = saves(directory.path(), newest, next, Some(step));
                    assert_eq!(status.signal(), Some(9), "{status}");
                    if step == SaveStep::Published {
                        (before, newest) = (newest, next);
                    }
                    let (_, warnings) = load(directory.path(), newest);
                    let latest = directory.path().join("latest.ckpt");
                    if newest == 0 || latest.exists() {
                        assert_eq!(warnings, [] as [String; 0], "after {first:?}, {second:?}, {third:?}");
                    } else {
                        assert_eq!(warnings.len(), 2);
                        assert!(
                            warnings[0].contains("latest.ckpt: missing, probably after a crash")
                                && warnings[1].contains(&format!("previous.ckpt, after {newest} updates")),
                            "{warnings:?}"
                        );
                        assert_ne!(step, SaveStep::Published);
                    }
                    let left = names(directory.path()).contains("latest.ckpt.new");
                    assert_eq!(left, step != SaveStep::Published);
                }
                assert!(saves(directory.path(), newest, 4, None).success());
                let (_, warnings) = load(directory.path(), 4);
                assert_eq!(warnings, [] as [String; 0]);
                let expected: &[&str] = match newest {
                    0 => &["latest.ckpt"],
                    _ => &["latest.ckpt", "previous.ckpt"],
                };
                assert!(
                    names(directory.path()).iter().eq(expected),
                    "{:?}",
                    names(directory.path())
                );
                // The previous checkpoint is the newest before this one, not an older one.
                if newest > 0 {
                    assert!(before < newest);
                    fs::remove_file(directory.path().join("latest.ckpt")).unwrap();
                    load(directory.path(), newest);
                }
            }
        }
    }
}

/// Between the two renames there is no `latest.ckpt`. Only then is `previous.ckpt` the newest.
#[test]
fn each_step_leaves_the_expected_files() {
    for (step, files) in [
        (
            SaveStep::Prepared,
            &["latest.ckpt", "latest.ckpt.new", "previous.ckpt"][..],
        ),
        (SaveStep::Kept, &["latest.ckpt.new", "previous.ckpt"]),
        (SaveStep::Published, &["latest.ckpt", "previous.ckpt"]),
    ] {
        let directory = TempDir::new().unwrap();
        for (newest, next) in [(0, 1), (1, 2)] {
            assert!(saves(directory.path(), newest, next, None).success());
        }
        assert_eq!(saves(directory.path(), 2, 3, Some(step)).signal(), Some(9));
        assert!(
            names(directory.path()).iter().eq(files),
            "{step:?}: {:?}",
            names(directory.path())
        );
        let newest = if step == SaveStep::Published { 3 } else { 2 };
        let (_, warnings) = load(directory.path(), newest);
        assert_eq!(warnings.is_empty(), step != SaveStep::Kept, "{step:?}: {warnings:?}");
    }
}
