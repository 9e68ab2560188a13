//! The folder of a reproduction: run directories and results by experiment and seed. One command works in it at a time.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;

use super::experiment::{Effort, Experiment, Stage};
use super::result::Header;
use super::settings::Settings;

/// A folder that is this process's.
#[derive(Debug)]
pub(super) struct Folder {
    path: PathBuf,
    /// Holds the lock until it is dropped; the system releases it when this process dies.
    _lock: File,
}

impl Folder {
    /// Makes the folder if it is not there, and claims it.
    pub(super) fn open(path: &Path) -> anyhow::Result<Self> {
        let here = path.display();
        std::fs::create_dir_all(path).with_context(|| format!("cannot make {here}"))?;
        // Children have another working directory if they like.
        let path = std::fs::canonicalize(path).with_context(|| format!("cannot resolve {here}"))?;
        let lock = File::open(&path).with_context(|| format!("cannot open {here}"))?;
        match flock(&lock, FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(Self { path, _lock: lock }),
            Err(Errno::WOULDBLOCK) => {
                bail!("another `shoal reproduce` works in {here}: wait for it, or choose another directory with --out")
            }
            Err(errno) => Err(errno).with_context(|| format!("cannot lock {here}")),
        }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// The run directory of a seed.
    pub(super) fn run(&self, experiment: &Experiment, seed: u64) -> PathBuf {
        self.path.join(experiment.name).join(format!("seed-{seed}"))
    }

    /// The result of a seed at the end of a stage.
    pub(super) fn result(&self, experiment: &Experiment, stage: &Stage, seed: u64) -> PathBuf {
        let file = format!("seed-{seed}{}.json", stage.suffix);
        self.path.join(experiment.name).join(file)
    }

    /// The seeds whose results are there, in order.
    pub(super) fn seeds(&self, experiment: &Experiment, stage: &Stage) -> anyhow::Result<Vec<u64>> {
        let mut seeds: Vec<u64> = self.numbered(experiment, &format!("{}.json", stage.suffix))?;
        seeds.sort_unstable();
        Ok(seeds)
    }

    /// Refuses a folder with results or runs of this experiment that were made otherwise than they would be now.
    pub(super) fn check(&self, experiment: &Experiment, effort: Effort, settings: &Settings) -> anyhow::Result<()> {
        for stage in experiment.stages {
            for seed in self.seeds(experiment, stage)? {
                let path = self.result(experiment, stage, seed);
                Header::read(&path)?.check(&path, experiment, seed, stage.length(effort), settings)?;
            }
        }
        for seed in self.numbered(experiment, "")? {
            let run = self.run(experiment, seed);
            if run.join("config.toml").is_file() {
                Settings::of_run(&run, seed)?.check(&run, settings)?;
            }
        }
        Ok(())
    }

    /// The numbers N of what is called `seed-N<ending>` in an experiment's directory.
    fn numbered(&self, experiment: &Experiment, ending: &str) -> anyhow::Result<Vec<u64>> {
        let directory = self.path.join(experiment.name);
        if !directory.exists() {
            return Ok(Vec::new());
        }
        let reading = || format!("cannot read {}", directory.display());
        let mut numbers = Vec::new();
        for entry in std::fs::read_dir(&directory).with_context(reading)? {
            let name = entry.with_context(reading)?.file_name();
            let number = name
                .to_str()
                .and_then(|name| name.strip_prefix("seed-")?.strip_suffix(ending));
            numbers.extend(number.and_then(|number| number.parse::<u64>().ok()));
        }
        Ok(numbers)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_has_one_command_at_a_time() {
        let parent = tempfile::tempdir().unwrap();
        let path = parent.path().join("results");
        let folder = Folder::open(&path).unwrap();
        let error = Folder::open(&path).unwrap_err().to_string();
        assert!(error.contains("--out") && !error.contains('\n'), "{error}");
        drop(folder);
        Folder::open(&path).unwrap();
    }

    #[test]
    fn results_are_found_by_their_names() {
        let parent = tempfile::tempdir().unwrap();
        let folder = Folder::open(parent.path()).unwrap();
        let experiment = &super::super::point_mass::EXPERIMENTS[1];
        std::fs::create_dir_all(folder.run(experiment, 12)).unwrap();
        for name in [
            "seed-12.json",
            "seed-2.json",
            "seed-2-longer.json",
            "seed-2.json.new",
            "notes.txt",
        ] {
            std::fs::write(parent.path().join(experiment.name).join(name), "").unwrap();
        }
        assert_eq!(folder.seeds(experiment, &experiment.stages[0]).unwrap(), [2, 12]);
        assert_eq!(folder.seeds(experiment, &experiment.stages[1]).unwrap(), [2]);
        assert_eq!(folder.numbered(experiment, "").unwrap(), [12]);
    }
}
