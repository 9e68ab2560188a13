//! Runs the seeds that have no result yet, several at a time, until all have finished or a signal arrives.

use std::collections::{BTreeMap, VecDeque};
use std::sync::mpsc;

use anyhow::bail;
use shoal_run::jobs::run_jobs;
use shoal_run::signals::Signals;

use super::experiment::{Effort, Length};
use super::folder::Folder;
use super::progress::ProgressDisplay;
use super::request::{Job, JobName, ReproductionEnd};
use super::settings::RunSettings;
use super::training::{SeedState, TrainingEnd, train};

/// The seeds that have no result yet, and where their results go.
pub(super) struct SeedQueue<'a> {
    pub(super) folder: &'a Folder,
    pub(super) effort: Effort,
    pub(super) jobs: &'a [Job],
    pub(super) settings: &'a BTreeMap<&'static str, RunSettings>,
}

/// A message from a worker.
enum Event {
    Started(Job),
    /// A result has been stored.
    Stored(Job, Length),
    /// All results of a job have been stored.
    Finished(Job),
    Failed(Job, anyhow::Error),
}

impl SeedQueue<'_> {
    /// Runs all seeds, `parallel` of them at a time. `write` writes the report; it is called after each new result and
    /// at the end.
    pub(super) fn run(
        &self,
        parallel: usize,
        write: impl Fn(&BTreeMap<JobName, String>) -> anyhow::Result<()>,
    ) -> anyhow::Result<ReproductionEnd> {
        let signals = Signals::register()?;
        let due: VecDeque<Job> = self.jobs.iter().copied().filter(|job| self.is_due(job)).collect();
        let mut progress = ProgressDisplay::new(self.folder, self.effort, self.jobs.len(), &due)?;
        let mut failures = BTreeMap::new();
        let work = |job: Job, events: &mpsc::Sender<Event>| self.work(job, &signals, events);
        run_jobs(due, parallel, &signals, work, |event| {
            match event {
                None => {}
                Some(Event::Started(job)) => progress.started(job),
                Some(Event::Finished(job)) => progress.finished(&job),
                Some(Event::Stored(job, length)) => {
                    progress.stored(&job, length);
                    // Writing is tried again at the end. An error is reported then.
                    if self.effort == Effort::Full {
                        let _ = write(&failures);
                    }
                }
                Some(Event::Failed(job, error)) => {
                    // Paths in the report are relative to the folder, because the report may be read elsewhere.
                    let prefix = format!("{}/", self.folder.path().display());
                    let message = format!("{error:#}").replace(&prefix, "");
                    progress.failed(&job, &message);
                    failures.insert(job.name(), message);
                }
            }
            progress.draw();
        });
        progress.clear();
        write(&failures)?;
        Ok(match (signals.received(), failures.len()) {
            (None, 0) => ReproductionEnd::Complete,
            (None, failed) => ReproductionEnd::Failed(failed),
            (Some(signal), _) => ReproductionEnd::Interrupted(signal),
        })
    }

    fn is_due(&self, job: &Job) -> bool {
        let mut milestones = job.experiment.milestones.iter();
        milestones.any(|milestone| !self.folder.has(job.experiment, milestone, job.seed))
    }

    fn work(&self, job: Job, signals: &Signals, events: &mpsc::Sender<Event>) {
        // A closed channel does not end the work: the results are still stored.
        let _ = events.send(Event::Started(job));
        match self.reach_milestones(job, signals, events) {
            Ok(TrainingEnd::Finished) => _ = events.send(Event::Finished(job)),
            Ok(TrainingEnd::Interrupted) => {}
            Err(error) => _ = events.send(Event::Failed(job, error)),
        }
    }

    fn reach_milestones(
        &self,
        job: Job,
        signals: &Signals,
        events: &mpsc::Sender<Event>,
    ) -> anyhow::Result<TrainingEnd> {
        let Job {
            family,
            experiment,
            seed,
        } = job;
        let run = self.folder.run(experiment, seed);
        for milestone in experiment.milestones {
            if self.folder.has(experiment, milestone, seed) {
                continue;
            }
            let length = milestone.length(self.effort);
            let (done, total) = length.done_and_total(SeedState::of(&run)?.progress());
            if matches!(length, Length::Steps(_)) && done > total {
                bail!(
                    "{} has trained beyond {length} without a stored result: remove the run directory to start the \
                     run again",
                    run.display()
                );
            }
            if train(experiment, self.effort, seed, length, &run, &|| signals.received())? == TrainingEnd::Interrupted {
                return Ok(TrainingEnd::Interrupted);
            }
            (family.store_result)(
                self.folder,
                experiment,
                milestone,
                seed,
                length,
                &self.settings[experiment.name],
            )?;
            let _ = events.send(Event::Stored(job, length));
        }
        Ok(TrainingEnd::Finished)
    }
}
