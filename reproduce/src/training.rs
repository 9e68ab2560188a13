//! One training: this program, started again as `train` or `resume`.

use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, bail};
use rustix::process::Signal;
use shoal_common::run_dir::{RunDir, RunDirError};
use shoal_run::evaluation::WhichPolicy;
use shoal_run::process::Peer;
use shoal_run::status;

use super::experiment::{Effort, Experiment, Length, Progress};

/// How often it is looked whether a signal has come.
const ROUND: Duration = Duration::from_millis(100);

/// How a run directory stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RunState {
    Absent,
    Begun(Progress),
}

/// How a training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Trained {
    Through,
    /// A signal came; its state is saved.
    Interrupted,
}

impl RunState {
    pub(super) fn of(run: &Path) -> anyhow::Result<Self> {
        // Who was killed before anything was written leaves an empty directory.
        let _ = std::fs::remove_dir(run);
        if !run.exists() {
            return Ok(Self::Absent);
        }
        let directory = RunDir::open(run)?;
        if directory.goes_on()? {
            return Err(RunDirError::Busy(run.into()).into());
        }
        let rest = status::at_rest(&directory.config()?, &directory)?;
        Ok(Self::Begun(Progress {
            steps: rest.env_steps,
            episodes: rest.episodes,
        }))
    }

    /// How far it is.
    pub(super) fn progress(self) -> Progress {
        match self {
            Self::Absent => Progress::default(),
            Self::Begun(progress) => progress,
        }
    }
}

/// The signal that is to end everything in order, if one has come.
pub(super) type Interrupted<'a> = &'a dyn Fn() -> Option<i32>;

/// Brings the run to this length, from wherever it stands, or ends it in order before.
pub(super) fn train(
    experiment: &Experiment,
    effort: Effort,
    seed: u64,
    length: Length,
    run: &Path,
    interrupted: Interrupted<'_>,
) -> anyhow::Result<Trained> {
    let mut command = Command::new("/proc/self/exe");
    command.arg0("shoal");
    match RunState::of(run)? {
        RunState::Begun(progress) if has_ended(run, length, progress)? => return Ok(Trained::Through),
        RunState::Absent => {
            command
                .args(["train", experiment.preset, "--lockstep", "--run"])
                .arg(run);
            command.args(["--seed", &seed.to_string()]);
            // A run keeps to one core: the others have runs of their own.
            let settings = experiment.settings(effort);
            for setting in settings.chain(["learner.threads=1"]) {
                command.args(["--set", setting]);
            }
        }
        RunState::Begun(_) => {
            command.arg("resume").arg(run);
        }
    }
    command.args(length.argument()).arg("--quiet");
    run_child(&mut command, interrupted)
}

/// Whether a run has come to this length, and ended in order there: then it leaves its last policy.
fn has_ended(run: &Path, length: Length, progress: Progress) -> anyhow::Result<bool> {
    let run = RunDir::open(run)?;
    if !run.last_policy().exists() {
        return Ok(false);
    }
    let steps = WhichPolicy::Last.read(&run, &run.config()?)?.env_steps;
    Ok(match length {
        Length::Steps(wanted) => steps >= wanted,
        Length::Episodes(wanted) => progress.episodes >= wanted && steps == progress.steps,
    })
}

fn run_child(command: &mut Command, interrupted: Interrupted<'_>) -> anyhow::Result<Trained> {
    let mut training = Peer::start(command, "training".into()).context("cannot start a training")?;
    let mut told = false;
    let status = loop {
        if let Some(status) = training.wait(ROUND) {
            break status;
        }
        if interrupted().is_some() && !told {
            told = true;
            // Who does not hear it has ended.
            let _ = training.signal(Signal::TERM);
        }
    };
    if interrupted().is_some() {
        return Ok(Trained::Interrupted);
    }
    if !status.success() {
        bail!(
            "{}",
            training
                .last_words()
                .unwrap_or_else(|| format!("a training ended with {status}"))
        );
    }
    Ok(Trained::Through)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(script: &str, signal: Option<i32>) -> anyhow::Result<Trained> {
        run_child(Command::new("sh").args(["-c", script]), &|| signal)
    }

    #[test]
    fn a_training_that_fails_is_told_by_its_last_line() {
        assert_eq!(shell("exit 0", None).unwrap(), Trained::Through);
        let error = shell(
            "echo 'warning: hot' >&2; echo 'error: no room' >&2; echo >&2; exit 1",
            None,
        )
        .unwrap_err();
        assert_eq!(error.to_string(), "no room");
        assert!(shell("exit 3", None).unwrap_err().to_string().contains("3"));
    }

    #[test]
    fn a_signal_ends_the_training_in_order() {
        let begun = std::time::Instant::now();
        assert_eq!(
            shell("sleep 60 & trap 'kill $!; exit 143' TERM; wait", Some(15)).unwrap(),
            Trained::Interrupted
        );
        assert!(begun.elapsed() < Duration::from_secs(30));
    }

    #[test]
    fn an_empty_directory_is_no_run() {
        let parent = tempfile::tempdir().unwrap();
        let run = parent.path().join("seed-1");
        std::fs::create_dir(&run).unwrap();
        assert_eq!(RunState::of(&run).unwrap(), RunState::Absent);
        std::fs::create_dir(&run).unwrap();
        std::fs::write(run.join("notes"), "").unwrap();
        assert!(RunState::of(&run).is_err(), "what is not ours is left alone");
    }
}
