//! How far the whole batch is: one live line on a terminal, and a line for whatever happens.

use std::collections::BTreeMap;
use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use shoal_common::run_dir::RunDir;

use super::batch::{Job, Name};
use super::experiment::Effort;
use super::folder::Folder;
use super::training::Standing;
use crate::launcher::thousands;
use crate::recorder::recorded_steps;

/// The live line, and what is to be known for it.
pub(super) struct Progress<'a> {
    folder: &'a Folder,
    bar: ProgressBar,
    live: bool,
    all: usize,
    /// Every job that was due: its steps when the batch began, and at its end.
    due: BTreeMap<Name, (u64, u64)>,
    running: BTreeMap<Name, PathBuf>,
    over: Vec<Name>,
    begun: Instant,
}

impl<'a> Progress<'a> {
    pub(super) fn new<'j>(
        folder: &'a Folder,
        effort: Effort,
        all: usize,
        due: impl IntoIterator<Item = &'j Job>,
    ) -> anyhow::Result<Self> {
        let live = std::io::stderr().is_terminal();
        let due: BTreeMap<Name, (u64, u64)> = due
            .into_iter()
            .map(|job| {
                // What cannot be read is said when its turn comes.
                let standing = Standing::of(&folder.run(job.experiment, job.seed)).unwrap_or(Standing::Absent);
                (job.name(), (standing.steps(), job.experiment.last_steps(effort)))
            })
            .collect();
        let target = if live {
            ProgressDrawTarget::stderr()
        } else {
            ProgressDrawTarget::hidden()
        };
        let bar = ProgressBar::with_draw_target(Some(all as u64), target);
        bar.set_style(ProgressStyle::with_template("{bar:16.cyan/dim} {msg}")?.progress_chars("━━─"));
        let progress = Self {
            folder,
            bar,
            live,
            all,
            due,
            running: BTreeMap::new(),
            over: Vec::new(),
            begun: Instant::now(),
        };
        if !progress.due.is_empty() {
            progress.say(&format!("{} of {all} seeds are due", progress.due.len()));
        }
        Ok(progress)
    }

    pub(super) fn begun(&mut self, job: Job) {
        self.running
            .insert(job.name(), self.folder.run(job.experiment, job.seed));
        if !self.live {
            self.say(&format!("{}: begins", title(&job)));
        }
    }

    pub(super) fn kept(&self, job: &Job, steps: u64) {
        self.say(&format!("{}: result at {} steps", title(job), thousands(steps)));
    }

    pub(super) fn through(&mut self, job: &Job) {
        self.running.remove(&job.name());
        self.over.push(job.name());
        let left = self
            .left()
            .map(|left| format!(", about {left:#} left", left = HumanDuration(left)));
        self.say(&format!(
            "{}: done, {}{}",
            title(job),
            self.count(),
            left.unwrap_or_default()
        ));
    }

    pub(super) fn failed(&mut self, job: &Job, said: &str) {
        self.running.remove(&job.name());
        self.over.push(job.name());
        self.say(&format!("{}: failed: {said}", title(job)));
    }

    /// Draws the live line.
    pub(super) fn draw(&self) {
        if !self.live {
            return;
        }
        let mut parts = vec![self.count()];
        for ((name, seed), run) in &self.running {
            let steps = thousands(steps_of(run).unwrap_or(0));
            let end = self.due.get(&(*name, *seed)).map_or(0, |(_, end)| *end);
            parts.push(format!("{name} {seed}: {steps} of {}", thousands(end)));
        }
        if let Some(left) = self.left() {
            parts.push(format!("{:#} left", HumanDuration(left)));
        }
        self.bar
            .set_position((self.all - self.due.len() + self.over.len()) as u64);
        self.bar.set_message(parts.join(" · "));
    }

    pub(super) fn clear(&self) {
        self.bar.finish_and_clear();
    }

    fn count(&self) -> String {
        format!("{} of {} seeds", self.all - self.due.len() + self.over.len(), self.all)
    }

    /// From the steps that remain, at the rate of this batch so far.
    fn left(&self) -> Option<Duration> {
        let (mut taken, mut remaining) = (0, 0);
        for (name, (begin, end)) in &self.due {
            let now = match self.running.get(name) {
                _ if self.over.contains(name) => *end,
                Some(run) => steps_of(run).unwrap_or(*begin).max(*begin).min(*end),
                None => *begin,
            };
            taken += now.saturating_sub(*begin);
            remaining += end.saturating_sub(now);
        }
        let seconds = self.begun.elapsed().as_secs_f64() * remaining as f64 / taken as f64;
        (taken > 0 && remaining > 0).then(|| Duration::from_secs(seconds as u64))
    }

    fn say(&self, line: &str) {
        self.bar.suspend(|| {
            // Where nobody reads, there is nobody to tell.
            let _ = writeln!(std::io::stderr(), "{line}");
        });
    }
}

/// By the run's records.
fn steps_of(run: &std::path::Path) -> Option<u64> {
    recorded_steps(&RunDir::planned(run)).ok()?
}

fn title(job: &Job) -> String {
    format!("{} seed {}", job.experiment.name, job.seed)
}
