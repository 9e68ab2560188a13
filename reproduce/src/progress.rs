//! How far the whole batch is: one live line on a terminal, and a line for whatever happens.

use std::collections::BTreeMap;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use shoal_common::run_dir::RunDir;
use shoal_run::numbers::thousands;
use shoal_run::recorder::recorded;

use super::experiment::{self, Effort, Length};
use super::folder::Folder;
use super::order::{Job, Name};
use super::training::RunState;

/// The live line, and what is to be known for it.
pub(super) struct Progress<'a> {
    folder: &'a Folder,
    bar: ProgressBar,
    live: bool,
    all: usize,
    /// Every job that was due.
    due: BTreeMap<Name, Due>,
    running: BTreeMap<Name, PathBuf>,
    over: Vec<Name>,
    begun: Instant,
}

/// A job that was due. An episode is taken for as much work as a step: where there are both, one is as quick as the other
/// is slow.
struct Due {
    length: Length,
    /// Steps or episodes when the batch began.
    begin: u64,
}

impl Due {
    fn done(&self, run: &Path) -> Option<u64> {
        let (steps, episodes) = recorded(&RunDir::planned(run)).ok()??;
        Some(self.length.done(experiment::Progress { steps, episodes }).0)
    }

    fn all(&self) -> u64 {
        self.length.done(experiment::Progress::default()).1
    }
}

impl<'a> Progress<'a> {
    pub(super) fn new<'j>(
        folder: &'a Folder,
        effort: Effort,
        all: usize,
        due: impl IntoIterator<Item = &'j Job>,
    ) -> anyhow::Result<Self> {
        let live = std::io::stderr().is_terminal();
        let due: BTreeMap<Name, Due> = due
            .into_iter()
            .filter_map(|job| {
                // What cannot be read is said when its turn comes.
                let standing = RunState::of(&folder.run(job.experiment, job.seed)).unwrap_or(RunState::Absent);
                let length = job.experiment.length(effort)?;
                let begin = length.done(standing.progress()).0;
                Some((job.name(), Due { length, begin }))
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

    pub(super) fn kept(&self, job: &Job, length: Length) {
        self.say(&format!("{}: result at {length}", title(job)));
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
            if let Some(due) = self.due.get(&(*name, *seed)) {
                let done = thousands(due.done(run).unwrap_or(due.begin));
                parts.push(format!("{name} {seed}: {done} of {}", due.length));
            }
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

    /// From what remains, at the rate of this batch so far.
    fn left(&self) -> Option<Duration> {
        let (mut taken, mut remaining) = (0, 0);
        for (name, due) in &self.due {
            let (begin, end) = (due.begin, due.all());
            let now = match self.running.get(name) {
                _ if self.over.contains(name) => end,
                Some(run) => due.done(run).unwrap_or(begin).max(begin).min(end),
                None => begin,
            };
            taken += now.saturating_sub(begin);
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

fn title(job: &Job) -> String {
    format!("{} seed {}", job.experiment.name, job.seed)
}
