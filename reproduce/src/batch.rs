//! Which seeds are due, so many of them at a time, until all are through or a signal comes.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Mutex, PoisonError, mpsc};
use std::time::Duration;

use anyhow::bail;
use shoal_run::signals::Signals;

use super::experiment::{Effort, Length};
use super::folder::Folder;
use super::order::{BatchEnding, Job, Name};
use super::progress::Progress;
use super::settings::RunSettings;
use super::training::{RunState, Trained, train};

/// How often the live line is drawn.
const ROUND: Duration = Duration::from_secs(1);

/// Seeds to bring through, in a folder.
pub(super) struct Batch<'a> {
    pub(super) folder: &'a Folder,
    pub(super) effort: Effort,
    pub(super) jobs: &'a [Job],
    pub(super) settings: &'a BTreeMap<&'static str, RunSettings>,
}

/// What a worker tells.
enum Event {
    Begun(Job),
    /// A result is there.
    Kept(Job, Length),
    /// All of a job's results are there.
    Through(Job),
    Failed(Job, anyhow::Error),
}

impl Batch<'_> {
    /// Brings all seeds through, `at_once` of them side by side. `write` is called whenever there is something new to
    /// report, and at the end.
    pub(super) fn run(
        &self,
        at_once: usize,
        write: impl Fn(&BTreeMap<Name, String>) -> anyhow::Result<()>,
    ) -> anyhow::Result<BatchEnding> {
        let signals = Signals::register()?;
        let due: VecDeque<Job> = self.jobs.iter().copied().filter(|job| self.is_due(job)).collect();
        let mut progress = Progress::new(self.folder, self.effort, self.jobs.len(), &due)?;
        let queue = Mutex::new(due);
        let mut failures = BTreeMap::new();
        std::thread::scope(|scope| {
            let (events, heard) = mpsc::channel();
            for _ in 0..at_once {
                let (events, queue, signals) = (events.clone(), &queue, &signals);
                scope.spawn(move || self.work(queue, signals, &events));
            }
            drop(events);
            loop {
                match heard.recv_timeout(ROUND) {
                    Ok(Event::Begun(job)) => progress.begun(job),
                    Ok(Event::Through(job)) => progress.through(&job),
                    Ok(Event::Kept(job, length)) => {
                        progress.kept(&job, length);
                        // What cannot be written now is tried again at the end, and said then.
                        if self.effort == Effort::Full {
                            let _ = write(&failures);
                        }
                    }
                    Ok(Event::Failed(job, error)) => {
                        // The report may be read anywhere: it names places within the folder.
                        let here = format!("{}/", self.folder.path().display());
                        let said = format!("{error:#}").replace(&here, "");
                        progress.failed(&job, &said);
                        failures.insert(job.name(), said);
                    }
                    Err(mpsc::RecvTimeoutError::Timeout) => {}
                    Err(mpsc::RecvTimeoutError::Disconnected) => break,
                }
                progress.draw();
            }
        });
        progress.clear();
        write(&failures)?;
        Ok(match (signals.received(), failures.len()) {
            (None, 0) => BatchEnding::Complete,
            (None, failed) => BatchEnding::Failed(failed),
            (Some(signal), _) => BatchEnding::Interrupted(signal),
        })
    }

    fn is_due(&self, job: &Job) -> bool {
        let mut stages = job.experiment.stages.iter();
        stages.any(|stage| !self.folder.has(job.experiment, stage, job.seed))
    }

    /// Takes one job after the other until there is none, or a signal has come.
    fn work(&self, queue: &Mutex<VecDeque<Job>>, signals: &Signals, events: &mpsc::Sender<Event>) {
        let next = || {
            let mut queue = queue.lock().unwrap_or_else(PoisonError::into_inner);
            queue.pop_front().filter(|_| signals.received().is_none())
        };
        while let Some(job) = next() {
            // Nobody listens only where the report could not be written; then the seed is brought through all the same.
            let _ = events.send(Event::Begun(job));
            match self.bring_through(job, signals, events) {
                Ok(Trained::Through) => _ = events.send(Event::Through(job)),
                Ok(Trained::Interrupted) => return,
                Err(error) => _ = events.send(Event::Failed(job, error)),
            }
        }
    }

    fn bring_through(&self, job: Job, signals: &Signals, events: &mpsc::Sender<Event>) -> anyhow::Result<Trained> {
        let Job {
            family,
            experiment,
            seed,
        } = job;
        let run = self.folder.run(experiment, seed);
        for stage in experiment.stages {
            if self.folder.has(experiment, stage, seed) {
                continue;
            }
            let length = stage.length(self.effort);
            let (done, all) = length.done(RunState::of(&run)?.progress());
            if matches!(length, Length::Steps(_)) && done > all {
                bail!(
                    "{} is beyond {length}, and its result there was not kept: remove the run to begin it again",
                    run.display()
                );
            }
            if train(experiment, self.effort, seed, length, &run, &|| signals.received())? == Trained::Interrupted {
                return Ok(Trained::Interrupted);
            }
            (family.keep)(
                self.folder,
                experiment,
                stage,
                seed,
                length,
                &self.settings[experiment.name],
            )?;
            let _ = events.send(Event::Kept(job, length));
        }
        Ok(Trained::Through)
    }
}
