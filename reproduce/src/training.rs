//! One training: starts this program as `shoal train` or `shoal resume`.

use std::path::Path;
use std::process::Command;

use shoal_common::run_dir::{RunDir, RunDirError};
use shoal_run::child_process::tied;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::interrupted_start::remove_interrupted_start;
pub(super) use shoal_run::jobs::TrainingEnd;
use shoal_run::jobs::run_training;
use shoal_run::status;

use super::experiment::{Effort, Experiment, Length, Progress};

/// The state of a run directory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SeedState {
    Absent,
    Started(Progress),
}

impl SeedState {
    pub(super) fn of(run: &Path) -> anyhow::Result<Self> {
        if remove_interrupted_start(run)? {
            return Ok(Self::Absent);
        }
        let directory = RunDir::open(run)?;
        if directory.keeps_running()? {
            return Err(RunDirError::Busy(run.into()).into());
        }
        let saved = status::saved_status(&directory.config()?, &directory)?;
        Ok(Self::Started(Progress {
            steps: saved.env_steps,
            episodes: saved.episodes,
        }))
    }

    pub(super) fn progress(self) -> Progress {
        match self {
            Self::Absent => Progress::default(),
            Self::Started(progress) => progress,
        }
    }
}

/// Returns the signal to terminate, if one has been received.
pub(super) type Interrupted<'a> = &'a dyn Fn() -> Option<i32>;

/// Trains the run up to this length, or until a signal interrupts it. A started run is resumed.
pub(super) fn train(
    experiment: &Experiment,
    effort: Effort,
    seed: u64,
    length: Length,
    run: &Path,
    interrupted: Interrupted<'_>,
) -> anyhow::Result<TrainingEnd> {
    let mut command = Command::new("/proc/self/exe");
    match SeedState::of(run)? {
        SeedState::Started(progress) if has_ended(run, length, progress)? => return Ok(TrainingEnd::Finished),
        SeedState::Absent => {
            command
                .args(["train", experiment.preset, "--lockstep", "--run"])
                .arg(run);
            command.args(["--seed", &seed.to_string()]);
            // One learner thread, because other runs use the other cores.
            let settings = experiment.settings(effort);
            for setting in settings.chain(["learner.threads=1"]) {
                command.args(["--set", setting]);
            }
        }
        SeedState::Started(_) => {
            command.arg("resume").arg(run);
        }
    }
    command.args(length.arguments()).arg("--quiet");
    let has_finished = || match SeedState::of(run)? {
        SeedState::Started(progress) => has_ended(run, length, progress),
        SeedState::Absent => Ok(false),
    };
    // Tied to this process: if that is killed, the run ends, and the same command continues it.
    run_training(&mut tied(&command)?, interrupted, has_finished)
}

/// Whether a run has reached this length and ended normally there, which leaves its last policy.
fn has_ended(run: &Path, length: Length, progress: Progress) -> anyhow::Result<bool> {
    let run = RunDir::open(run)?;
    let Some(last) = SavedPolicy::Last.read_if_any(&run, &run.config()?)? else {
        return Ok(false);
    };
    let steps = last.env_steps;
    // The last policy is also written when a signal ends the run at its last step, before it is evaluated.
    let finished = status::saved_status(&run.config()?, &run)?.finished;
    Ok(match length {
        Length::Steps(wanted) => steps > wanted || (steps == wanted && finished),
        Length::Episodes(wanted) => progress.episodes >= wanted && steps == progress.steps && finished,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_empty_directory_is_not_a_run() {
        let parent = tempfile::tempdir().unwrap();
        let run = parent.path().join("seed-1");
        std::fs::create_dir(&run).unwrap();
        assert_eq!(SeedState::of(&run).unwrap(), SeedState::Absent);
        std::fs::create_dir(&run).unwrap();
        std::fs::write(run.join("notes"), "").unwrap();
        assert!(SeedState::of(&run).is_err(), "a directory with other files is an error");
    }
}
