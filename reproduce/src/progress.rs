//! Shows the progress of a reproduction: one live line on a terminal, and one line for each event.

use std::collections::BTreeMap;
use std::io::IsTerminal;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use shoal_common::message::say;
use shoal_common::run_dir::RunDir;
use shoal_run::numbers::thousands;
use shoal_run::records::recorder::recorded;

use super::experiment::{self, Effort, Length};
use super::folder::Folder;
use super::request::{Job, JobName};
use super::training::SeedState;

/// The live line and its data.
pub(super) struct ProgressDisplay<'a> {
    folder: &'a Folder,
    bar: ProgressBar,
    live: bool,
    /// Number of all jobs, including jobs that had finished before this command began.
    total: usize,
    /// Every job that had not finished when this command began.
    due: BTreeMap<JobName, Due>,
    running: BTreeMap<JobName, PathBuf>,
    ended: Vec<JobName>,
    started_at: Instant,
}

/// A job that had not finished when this command began. For the estimate of the remaining time, an episode counts as
/// much as an environment step.
struct Due {
    length: Length,
    /// Environment steps or episodes when this command began.
    begin: u64,
}

impl Due {
    fn done(&self, run: &Path) -> Option<u64> {
        let (steps, episodes) = recorded(&RunDir::at(run)).ok()??;
        Some(self.length.done_and_total(experiment::Progress { steps, episodes }).0)
    }

    fn total(&self) -> u64 {
        self.length.done_and_total(experiment::Progress::default()).1
    }
}

impl<'a> ProgressDisplay<'a> {
    pub(super) fn new<'j>(
        folder: &'a Folder,
        effort: Effort,
        total: usize,
        due: impl IntoIterator<Item = &'j Job>,
    ) -> anyhow::Result<Self> {
        let live = std::io::stderr().is_terminal();
        let due: BTreeMap<JobName, Due> = due
            .into_iter()
            .filter_map(|job| {
                // If the run cannot be read, the error is reported when the job starts.
                let state = SeedState::of(&folder.run(job.experiment, job.seed)).unwrap_or(SeedState::Absent);
                let length = job.experiment.length(effort)?;
                let begin = length.done_and_total(state.progress()).0;
                Some((job.name(), Due { length, begin }))
            })
            .collect();
        let target = if live {
            ProgressDrawTarget::stderr()
        } else {
            ProgressDrawTarget::hidden()
        };
        let bar = ProgressBar::with_draw_target(Some(total as u64), target);
        bar.set_style(ProgressStyle::with_template("{bar:16.cyan/dim} {msg}")?.progress_chars("━━─"));
        let progress = Self {
            folder,
            bar,
            live,
            total,
            due,
            running: BTreeMap::new(),
            ended: Vec::new(),
            started_at: Instant::now(),
        };
        if !progress.due.is_empty() {
            progress.print(&format!("{} of {total} seeds to run", progress.due.len()));
        }
        Ok(progress)
    }

    pub(super) fn started(&mut self, job: Job) {
        self.running
            .insert(job.name(), self.folder.run(job.experiment, job.seed));
        if !self.live {
            self.print(&format!("{}: started", title(&job)));
        }
    }

    pub(super) fn stored(&self, job: &Job, length: Length) {
        self.print(&format!("{}: result at {length} stored", title(job)));
    }

    pub(super) fn finished(&mut self, job: &Job) {
        self.running.remove(&job.name());
        self.ended.push(job.name());
        let left = self
            .time_left()
            .map(|left| format!(", about {left:#} left", left = HumanDuration(left)));
        self.print(&format!(
            "{}: done, {}{}",
            title(job),
            self.count(),
            left.unwrap_or_default()
        ));
    }

    pub(super) fn failed(&mut self, job: &Job, message: &str) {
        self.running.remove(&job.name());
        self.ended.push(job.name());
        self.print(&format!("{}: failed: {message}", title(job)));
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
        if let Some(left) = self.time_left() {
            parts.push(format!("{:#} left", HumanDuration(left)));
        }
        self.bar.set_position(self.completed() as u64);
        self.bar.set_message(parts.join(" · "));
    }

    pub(super) fn clear(&self) {
        self.bar.finish_and_clear();
    }

    fn completed(&self) -> usize {
        self.total - self.due.len() + self.ended.len()
    }

    fn count(&self) -> String {
        format!("{} of {} seeds", self.completed(), self.total)
    }

    /// The time that the remaining work takes at this command's rate so far.
    fn time_left(&self) -> Option<Duration> {
        let (mut done, mut remaining) = (0, 0);
        for (name, due) in &self.due {
            let (begin, end) = (due.begin, due.total());
            let now = match self.running.get(name) {
                _ if self.ended.contains(name) => end,
                Some(run) => due.done(run).unwrap_or(begin).max(begin).min(end),
                None => begin,
            };
            done += now.saturating_sub(begin);
            remaining += end.saturating_sub(now);
        }
        let seconds = self.started_at.elapsed().as_secs_f64() * remaining as f64 / done as f64;
        (done > 0 && remaining > 0).then(|| Duration::from_secs(seconds as u64))
    }

    fn print(&self, line: &str) {
        self.bar.suspend(|| say(line));
    }
}

fn title(job: &Job) -> String {
    format!("{} seed {}", job.experiment.name, job.seed)
}
