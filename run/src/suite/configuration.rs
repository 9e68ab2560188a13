//! The configurations of a suite's runs.

use std::path::Path;

use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

use super::{Suite, Trial, lock};
use crate::interrupted_start::remove_interrupted_start;
use crate::plan::{self, RequestedChanges, Revision, RunOverrides};
use crate::usage::UsageError;

/// Changes all runs of the suite in this directory, each change as `SECTION.KEY=VALUE`. They are checked for each run
/// and stored, so that the suite can be interrupted.
///
/// # Errors
/// When a run cannot have such a change, or another process works on the suite.
pub fn change(directory: &Path, changes: &[String]) -> anyhow::Result<()> {
    if changes.is_empty() {
        return Ok(());
    }
    let _lock = lock(directory)?;
    let mut suite = Suite::open(directory)?;
    suite.change(changes).map_err(UsageError)?;
    for trial in &suite.trials {
        let path = directory.join(&trial.name);
        if !remove_interrupted_start(&path)? {
            let run = RunDir::open(&path)?;
            Revision::new(&run, &run.config()?, &requested(&suite))?;
        }
    }
    check(&suite)?;
    suite.write(directory)
}

/// The changes of all runs, for a run that exists.
pub(super) fn requested(suite: &Suite) -> RequestedChanges {
    RequestedChanges {
        set: suite.changes.clone(),
        ..RequestedChanges::default()
    }
}

/// Checks the configuration of each combination of values. Returns the usual name of a run of this kind.
///
/// # Errors
/// When one of them cannot be trained.
pub fn check(suite: &Suite) -> anyhow::Result<String> {
    let mut checked: Vec<&[String]> = Vec::new();
    let mut name = String::new();
    for trial in &suite.trials {
        if checked.contains(&trial.set.as_slice()) {
            continue;
        }
        checked.push(&trial.set);
        let config;
        (name, config) = plan::resolve(&suite.what, &overrides_of(suite, trial)?)?;
        check_first_round(suite, &config)?;
    }
    Ok(name)
}

/// Checks that a run is evaluated before the first round of halving ends.
fn check_first_round(suite: &Suite, config: &Config) -> anyhow::Result<()> {
    let Some(round) = suite.next_round() else {
        return Ok(());
    };
    let end = round.share * config.run.steps as f64;
    for (first, what, key) in [
        (config.evaluation.every, "evaluation comes after", "evaluation.every"),
        (config.replay.warmup.saturating_add(1), "update after", "replay.warmup"),
    ] {
        if config.run.episodes.is_none() && end < first as f64 {
            let text = format!(
                "--halving: the first round ends after {end:.0} steps of each run, and the first {what} {first}: lower \
                 {key}, or give the runs more steps"
            );
            return Err(UsageError(text).into());
        }
    }
    Ok(())
}

/// The overrides of this run: those of all runs of the suite, and its own.
pub(super) fn overrides_of(suite: &Suite, trial: &Trial) -> anyhow::Result<RunOverrides> {
    let common = RunOverrides::from_arguments(&suite.arguments)?;
    let set = common.set.iter().chain(&trial.set).chain(&suite.changes);
    Ok(RunOverrides {
        seed: trial.seed,
        set: set.cloned().collect(),
        ..common
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_suite_is_changed_although_the_start_of_a_run_was_interrupted() {
        let suite = Suite::new("pendulum".into(), vec![], &[], &[1, 2]).unwrap();
        let directory = tempfile::tempdir().unwrap();
        suite.write(directory.path()).unwrap();
        let interrupted = directory.path().join(&suite.trials[1].name);
        std::fs::create_dir(&interrupted).unwrap();
        std::fs::write(interrupted.join("config.toml.new"), "").unwrap();
        change(directory.path(), &["ddpg.tau=0.004".into()]).unwrap();
        assert_eq!(Suite::open(directory.path()).unwrap().changes, ["ddpg.tau=0.004"]);
        assert!(!interrupted.exists());
    }
}
