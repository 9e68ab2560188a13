//! The folder of a reproduction: results by experiment, and run directories by experiment and seed. Only one command
//! can use it at a time.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

use anyhow::{Context, bail};
use serde::Serialize;
use serde::de::DeserializeOwned;
use shoal_common::file_lock;

use super::experiment::{Effort, Experiment, Milestone};
use super::result::{self, ResultHeader, SeedResult};
use super::results_file::{ResultsFile, numbered};
use super::settings::RunSettings;

/// A folder that this process has locked.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    /// By name of the experiment. Seeds that run at the same time add results to the same file.
    results: Mutex<BTreeMap<&'static str, ResultsFile>>,
    /// Holds the lock until it is dropped. The system releases it if this process dies.
    _lock: File,
}

impl Folder {
    /// Creates the folder if necessary, locks it, and reads the results of these experiments.
    pub(super) fn open(
        path: &Path,
        experiments: impl IntoIterator<Item = &'static Experiment>,
    ) -> anyhow::Result<Self> {
        let here = path.display();
        std::fs::create_dir_all(path).with_context(|| format!("cannot create {here}"))?;
        // The path must not depend on a working directory.
        let path = std::fs::canonicalize(path).with_context(|| format!("cannot resolve {here}"))?;
        let lock = File::open(&path).with_context(|| format!("cannot open {here}"))?;
        if !file_lock::lock(&lock, file_lock::RELEASE_TIMEOUT).with_context(|| format!("cannot lock {here}"))? {
            bail!("another `shoal reproduce` is using {here}: wait for it, or choose another directory with --out");
        }
        let results = experiments
            .into_iter()
            .map(|experiment| Ok((experiment.name, ResultsFile::read(&path, experiment)?)))
            .collect::<anyhow::Result<_>>()?;
        Ok(Self {
            path,
            results: Mutex::new(results),
            _lock: lock,
        })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// The run directory of a seed.
    pub(super) fn run(&self, experiment: &Experiment, seed: u64) -> PathBuf {
        self.path.join(experiment.name).join(format!("seed-{seed}"))
    }

    /// Whether there is a result for this seed and milestone.
    pub(super) fn has(&self, experiment: &Experiment, milestone: &Milestone, seed: u64) -> bool {
        self.results()[experiment.name].has(milestone, seed)
    }

    /// The seeds that have a result for this milestone, in ascending order.
    pub(super) fn seeds(&self, experiment: &Experiment, milestone: &Milestone) -> Vec<u64> {
        let results = self.results();
        results[experiment.name].of(milestone).map(|(seed, _)| seed).collect()
    }

    /// The results of a milestone, ordered by seed.
    pub(super) fn read<T: DeserializeOwned>(
        &self,
        experiment: &Experiment,
        milestone: &Milestone,
    ) -> anyhow::Result<Vec<SeedResult<T>>> {
        let results = self.results();
        results[experiment.name]
            .of(milestone)
            .map(|(_, line)| result::read(line))
            .collect()
    }

    /// Stores a result. It is on the disk when this returns.
    pub(super) fn add<T: Serialize>(
        &self,
        experiment: &Experiment,
        milestone: &Milestone,
        result: &SeedResult<T>,
    ) -> anyhow::Result<()> {
        let text = serde_json::to_string(result)?;
        let mut results = self.results();
        let file = results.get_mut(experiment.name);
        file.context("the folder was opened for other experiments")?
            .add(&text, milestone)
    }

    /// Returns an error if the folder has results or runs of this experiment that were made with other settings.
    pub(super) fn check(&self, experiment: &Experiment, effort: Effort, settings: &RunSettings) -> anyhow::Result<()> {
        for milestone in experiment.milestones {
            for (seed, line) in self.results()[experiment.name].of(milestone) {
                let length = milestone.length(effort);
                ResultHeader::read(line)?.check(&line.place, experiment, seed, length, settings)?;
            }
        }
        for seed in numbered(&self.path.join(experiment.name), "")? {
            let run = self.run(experiment, seed);
            if run.join("config.toml").is_file() {
                RunSettings::of_run(&run, seed)?.check(&run.display().to_string(), settings)?;
            }
        }
        Ok(())
    }

    /// Moves results from the format of earlier versions, one file per result, into the file of their experiment.
    pub(super) fn move_old_results(&self) -> anyhow::Result<()> {
        self.results().values_mut().try_for_each(ResultsFile::move_old_results)
    }

    fn results(&self) -> MutexGuard<'_, BTreeMap<&'static str, ResultsFile>> {
        self.results.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::super::point_mass::EXPERIMENTS;
    use super::super::result::tests::result;
    use super::*;

    #[test]
    fn only_one_command_can_use_a_folder() {
        let parent = tempfile::tempdir().unwrap();
        let path = parent.path().join("results");
        let folder = Folder::open(&path, []).unwrap();
        let error = Folder::open(&path, []).unwrap_err().to_string();
        assert!(error.contains("--out") && !error.contains('\n'), "{error}");
        drop(folder);
        Folder::open(&path, []).unwrap();
    }

    #[test]
    fn results_that_are_added_at_the_same_time_are_all_stored() {
        let directory = tempfile::tempdir().unwrap();
        let experiment = &EXPERIMENTS[1];
        let folder = Folder::open(directory.path(), [experiment]).unwrap();
        std::thread::scope(|scope| {
            for seed in 1..=8 {
                let folder = &folder;
                scope.spawn(move || {
                    let result = result(experiment, seed, seed as f64, ());
                    folder.add(experiment, &experiment.milestones[0], &result).unwrap();
                });
            }
        });
        drop(folder);
        let folder = Folder::open(directory.path(), [experiment]).unwrap();
        let [first, second] = experiment.milestones else {
            panic!("two milestones")
        };
        assert_eq!(folder.seeds(experiment, first), (1..=8).collect::<Vec<_>>());
        assert!(folder.has(experiment, first, 8) && !folder.has(experiment, second, 8));
        let read = folder.read::<()>(experiment, first).unwrap();
        assert!(
            (1..=8)
                .zip(&read)
                .all(|(seed, it)| *it == result(experiment, seed, seed as f64, ()))
        );
    }
}
