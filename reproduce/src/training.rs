//! One training: this program, started again as `train` or `resume`.

use std::fs::File;
use std::io::{Read, Seek};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use anyhow::{Context, bail};
use rustix::process::{Pid, Signal, kill_process};
use shoal_common::run_dir::{RunDir, RunDirError};
use shoal_run::evaluation::WhichPolicy;
use shoal_run::status;

use super::experiment::{Effort, Experiment, Length, Progress};

/// How often a training is looked at.
const ROUND: Duration = Duration::from_millis(50);

/// How a run directory stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Standing {
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

impl Standing {
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

/// Brings the run to this length, from wherever it stands. A `signal` other than 0 ends it in order.
pub(super) fn train(
    experiment: &Experiment,
    effort: Effort,
    seed: u64,
    length: Length,
    run: &Path,
    signal: &AtomicUsize,
) -> anyhow::Result<Trained> {
    let mut command = Command::new("/proc/self/exe");
    command.arg0("shoal");
    match Standing::of(run)? {
        Standing::Begun(progress) if has_ended(run, length, progress)? => return Ok(Trained::Through),
        Standing::Absent => {
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
        Standing::Begun(_) => {
            command.arg("resume").arg(run);
        }
    }
    command.args(length.argument()).arg("--quiet");
    conduct(&mut command, signal)
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

fn conduct(command: &mut Command, signal: &AtomicUsize) -> anyhow::Result<Trained> {
    let mut said = tempfile::tempfile().context("cannot make a temporary file")?;
    let mut child = command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(said.try_clone().context("cannot share a temporary file")?)
        // Ctrl-C is for this process, which ends the trainings in order.
        .process_group(0)
        .spawn()
        .context("cannot start a training")?;
    let status = wait(&mut child, signal).context("cannot wait for a training")?;
    if signal.load(Ordering::Relaxed) != 0 {
        return Ok(Trained::Interrupted);
    }
    if !status.success() {
        bail!(
            "{}",
            last_line(&mut said).unwrap_or_else(|| format!("a training ended with {status}"))
        );
    }
    Ok(Trained::Through)
}

fn wait(child: &mut Child, signal: &AtomicUsize) -> std::io::Result<std::process::ExitStatus> {
    let mut told = false;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        if signal.load(Ordering::Relaxed) != 0 && !told {
            told = true;
            // Who does not hear it has ended.
            let _ = kill_process(Pid::from_child(child), Signal::TERM);
        }
        std::thread::sleep(ROUND);
    }
}

fn last_line(said: &mut File) -> Option<String> {
    let mut text = String::new();
    said.rewind().ok()?;
    said.read_to_string(&mut text).ok()?;
    let line = text.lines().rfind(|line| !line.trim().is_empty())?;
    Some(line.trim().trim_start_matches("error: ").to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(script: &str, signal: usize) -> anyhow::Result<Trained> {
        conduct(Command::new("sh").args(["-c", script]), &AtomicUsize::new(signal))
    }

    #[test]
    fn a_training_that_fails_is_told_by_its_last_line() {
        assert_eq!(shell("exit 0", 0).unwrap(), Trained::Through);
        let error = shell(
            "echo 'warning: hot' >&2; echo 'error: no room' >&2; echo >&2; exit 1",
            0,
        )
        .unwrap_err();
        assert_eq!(error.to_string(), "no room");
        assert!(shell("exit 3", 0).unwrap_err().to_string().contains("3"));
    }

    #[test]
    fn a_signal_ends_the_training_in_order() {
        let begun = std::time::Instant::now();
        assert_eq!(
            shell("sleep 60 & trap 'kill $!; exit 143' TERM; wait", 15).unwrap(),
            Trained::Interrupted
        );
        assert!(begun.elapsed() < Duration::from_secs(30));
    }

    #[test]
    fn an_empty_directory_is_no_run() {
        let parent = tempfile::tempdir().unwrap();
        let run = parent.path().join("seed-1");
        std::fs::create_dir(&run).unwrap();
        assert_eq!(Standing::of(&run).unwrap(), Standing::Absent);
        std::fs::create_dir(&run).unwrap();
        std::fs::write(run.join("notes"), "").unwrap();
        assert!(Standing::of(&run).is_err(), "what is not ours is left alone");
    }
}
