//! Runs several trainings as child processes, a limited number at a time.

use std::collections::VecDeque;
use std::process::Command;
use std::sync::{Mutex, PoisonError, mpsc};
use std::time::Duration;

use anyhow::{Context, bail};
use rustix::process::Signal;

use crate::child_process::ChildProcess;
use crate::signals::Signals;

/// How often `observe` is called without an event.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// Interval at which a received signal is checked.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(100);

/// The number of trainings that keep the cores of this machine busy; each takes about two.
pub fn trainings_for_all_cores() -> usize {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    (cores / 2).max(1)
}

/// How a training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrainingEnd {
    /// In order.
    Finished,
    /// By a signal; its state is saved.
    Interrupted,
}

/// Processes the queue with at most `parallel` threads until it is empty or a signal has arrived. `work` may send
/// events, which this thread passes to `observe`; that is also called once a second without an event.
pub fn run_jobs<Job: Send, Event: Send>(
    queue: VecDeque<Job>,
    parallel: usize,
    signals: &Signals,
    work: impl Fn(Job, &mpsc::Sender<Event>) + Sync,
    mut observe: impl FnMut(Option<Event>),
) {
    let threads = parallel.min(queue.len());
    let queue = Mutex::new(queue);
    let next = || {
        let mut queue = queue.lock().unwrap_or_else(PoisonError::into_inner);
        queue.pop_front().filter(|_| signals.received().is_none())
    };
    let do_jobs = |events: mpsc::Sender<Event>| {
        while let Some(job) = next() {
            work(job, &events);
        }
    };
    std::thread::scope(|scope| {
        let (events, receiver) = mpsc::channel();
        let mut started = 0;
        while started < threads {
            let (events, do_jobs) = (events.clone(), &do_jobs);
            if std::thread::Builder::new()
                .spawn_scoped(scope, move || do_jobs(events))
                .is_err()
            {
                break;
            }
            started += 1;
        }
        // If the system allows fewer threads, they do all jobs; if it allows none, this thread does.
        if started == 0 {
            do_jobs(events);
        } else {
            drop(events);
        }
        loop {
            match receiver.recv_timeout(POLL_INTERVAL) {
                Ok(event) => observe(Some(event)),
                Err(mpsc::RecvTimeoutError::Timeout) => observe(None),
                Err(mpsc::RecvTimeoutError::Disconnected) => break,
            }
        }
    });
}

/// Runs a training to its end. A signal that `interrupted` returns is passed on to it. `has_finished` is called after
/// the training has ended without an error, because that is also how `shoal stop` ends it.
///
/// # Errors
/// When it cannot be started, was stopped, or fails: its last line.
pub fn run_training(
    command: &mut Command,
    interrupted: &dyn Fn() -> Option<i32>,
    has_finished: impl FnOnce() -> anyhow::Result<bool>,
) -> anyhow::Result<TrainingEnd> {
    let mut training = ChildProcess::start(command, "training".into()).context("cannot start a training")?;
    let mut terminated = false;
    let status = loop {
        if let Some(status) = training.wait(SIGNAL_INTERVAL) {
            break status;
        }
        if let Some(signal) = interrupted().filter(|_| !terminated) {
            terminated = true;
            // The same signal: the training ignores the signals that this process was started to ignore.
            let signal = Signal::from_named_raw(signal).unwrap_or(Signal::TERM);
            // This fails only if the training has ended.
            let _ = training.signal(signal);
        }
    };
    // After a signal it ends with 128 and the signal's number, or dies of it.
    let has_failed = status.code().is_some_and(|code| (1..128).contains(&code));
    if interrupted().is_some() && !has_failed {
        return Ok(TrainingEnd::Interrupted);
    }
    if !status.success() {
        bail!(
            "{}",
            training
                .last_error_line()
                .unwrap_or_else(|| format!("a training ended with {status}"))
        );
    }
    if !has_finished()? {
        bail!("it was stopped before its end");
    }
    Ok(TrainingEnd::Finished)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(script: &str, signal: Option<i32>) -> anyhow::Result<TrainingEnd> {
        run_training(Command::new("sh").args(["-c", script]), &|| signal, || Ok(true))
    }

    #[test]
    fn a_training_that_was_stopped_has_not_finished() {
        let stopped = run_training(&mut Command::new("true"), &|| None, || Ok(false));
        assert_eq!(stopped.unwrap_err().to_string(), "it was stopped before its end");
        let interrupted = run_training(&mut Command::new("true"), &|| Some(15), || Ok(false));
        assert_eq!(interrupted.unwrap(), TrainingEnd::Interrupted);
    }

    #[test]
    fn the_error_of_a_failed_training_is_its_last_line() {
        assert_eq!(shell("exit 0", None).unwrap(), TrainingEnd::Finished);
        let error = shell(
            "echo 'warning: hot' >&2; echo 'error: no room' >&2; echo >&2; exit 1",
            None,
        )
        .unwrap_err();
        assert_eq!(error.to_string(), "no room");
        assert!(shell("exit 3", None).unwrap_err().to_string().contains("3"));
    }

    #[test]
    fn a_signal_terminates_the_training() {
        let start = std::time::Instant::now();
        assert_eq!(
            shell("sleep 60 & trap 'kill $!; exit 143' TERM; wait", Some(15)).unwrap(),
            TrainingEnd::Interrupted
        );
        assert!(start.elapsed() < Duration::from_secs(30));
        let unsaved = shell("trap 'echo not saved >&2; exit 1' TERM; sleep 60 & wait", Some(15));
        assert_eq!(unsaved.unwrap_err().to_string(), "not saved");
    }

    #[test]
    fn every_job_is_done_once_by_several_threads() {
        let signals = Signals::register().unwrap();
        let mut done = Vec::new();
        let work = |job: u32, events: &mpsc::Sender<u32>| events.send(job * 2).unwrap();
        run_jobs((0..50).collect(), 3, &signals, work, |event| done.extend(event));
        done.sort_unstable();
        assert_eq!(done, (0..50).map(|job| job * 2).collect::<Vec<_>>());

        // The system cannot make so many threads.
        done.clear();
        run_jobs((0..2).collect(), usize::MAX, &signals, work, |event| done.extend(event));
        done.sort_unstable();
        assert_eq!(done, [0, 2]);
    }
}
