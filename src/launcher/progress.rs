//! The live line.

use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use shoal_common::config::Config;
use shoal_common::report::{EvaluationReport, LearnerReport};
use shoal_common::run_dir::RunDir;
use shoal_run::numbers::thousands;
use shoal_run::rate::{per_second, updates_per_step};

use super::requests::waiting;
use super::supervisor::Supervisor;

/// The time over which rates are averaged.
const SPAN: Duration = Duration::from_secs(5);

/// Shows the progress of a run on standard error, if that is a terminal.
#[derive(Debug)]
pub(super) struct Progress {
    bar: ProgressBar,
    /// Whether the bar counts episodes rather than steps.
    counts_episodes: bool,
    warmup: u64,
    updates_per_step: f64,
    learner: Option<LearnerReport>,
    /// Reports of the last [`SPAN`].
    recent: std::collections::VecDeque<(Duration, LearnerReport)>,
    evaluated: Option<EvaluationReport>,
    /// When the learner's last report arrived.
    reported: Instant,
    drawn: Instant,
}

impl Progress {
    pub(super) fn new(config: &Config, run: &RunDir, quiet: bool) -> Self {
        let target = if quiet {
            ProgressDrawTarget::hidden()
        } else {
            ProgressDrawTarget::stderr()
        };
        let length = config.run.episodes.unwrap_or(config.run.steps);
        let bar = ProgressBar::with_draw_target(Some(length), target);
        if let Ok(style) = ProgressStyle::with_template("{prefix:.bold} {bar:16.cyan/dim} {msg}") {
            bar.set_style(style.progress_chars("━━─"));
        }
        bar.set_prefix(run.name());
        bar.set_message("starting");
        Self {
            bar,
            counts_episodes: config.run.episodes.is_some(),
            warmup: config.replay.warmup,
            updates_per_step: config.replay.updates_per_step,
            learner: None,
            recent: [].into(),
            evaluated: None,
            reported: Instant::now(),
            drawn: Instant::now(),
        }
    }

    /// The learner's last report.
    pub(super) fn learner(&self) -> Option<&LearnerReport> {
        self.learner.as_ref()
    }

    /// The evaluator's last report.
    pub(super) fn evaluated(&self) -> Option<&EvaluationReport> {
        self.evaluated.as_ref()
    }

    pub(super) fn add_learner_report(&mut self, report: &LearnerReport, wall: Duration) {
        self.learner = Some(*report);
        self.reported = Instant::now();
        self.recent.push_back((wall, *report));
        while self.recent.front().is_some_and(|(then, _)| wall - *then > SPAN) {
            self.recent.pop_front();
        }
    }

    pub(super) fn set_evaluation(&mut self, report: &EvaluationReport) {
        self.evaluated = Some(*report);
    }

    pub(super) fn set_message(&self, message: &'static str) {
        self.bar.set_message(message);
    }

    /// Prints a line above the bar, if it is shown.
    pub(super) fn print(&self, text: &str) {
        self.bar.println(text);
    }

    pub(super) fn clear(&self) {
        self.bar.finish_and_clear();
    }

    pub(super) fn draw(&mut self, supervisor: &Supervisor) {
        if self.drawn.elapsed() < Duration::from_millis(250) || self.bar.is_hidden() {
            return;
        }
        self.drawn = Instant::now();
        let Some(learner) = self.learner else { return };
        self.bar.set_position(self.done(&learner));
        self.bar.set_message(self.line(&learner, supervisor));
    }

    /// One line each for the progress, for the last evaluation and the rates, for the ratio and who waits, and for
    /// restarts if there were any. Each fits into 80 columns.
    fn line(&self, learner: &LearnerReport, supervisor: &Supervisor) -> String {
        let (done, all) = (self.done(learner), self.bar.length().unwrap_or(0));
        let unit = if self.counts_episodes { "episodes" } else { "steps" };
        let mut distance = vec![format!("{}/{} {unit}", thousands(done), thousands(all))];
        if let Some(pace) = self.pace(|report| self.done(report)).filter(|pace| *pace > 0.0) {
            let left = all.saturating_sub(done) as f64 / pace;
            distance.push(format!("{} left", HumanDuration(Duration::from_secs_f64(left))));
        }
        let mut pace = Vec::new();
        if let Some(evaluated) = &self.evaluated {
            pace.push(format!("eval {:.2}", evaluated.return_mean));
        }
        let updates = thousands(learner.updates);
        match self.rates() {
            Some((rate, env_steps)) => pace.push(format!("{updates} updates, {rate:.0}/s · {env_steps:.0} steps/s")),
            None => pace.push(format!("{updates} updates")),
        }
        let ratio = updates_per_step(learner.updates, learner.env_steps, self.warmup).unwrap_or(0.0);
        let waits = waiting(supervisor).map(|who| format!(", {who}")).unwrap_or_default();
        let ratio = format!("ratio {ratio:.2} of {:.2}{waits}", self.updates_per_step);
        let mut lines = vec![distance.join(" · "), pace.join(" · "), ratio];
        if supervisor.restarts() > 0 {
            lines.push(format!("{} restarts; see shoal.log", supervisor.restarts()));
        }
        lines.join("\n  ")
    }

    /// Episodes so far, if the run has a limit of episodes; otherwise steps.
    fn done(&self, learner: &LearnerReport) -> u64 {
        if self.counts_episodes {
            learner.episodes
        } else {
            learner.env_steps
        }
    }

    /// Updates and environment steps per second; `None` without recent reports from the learner.
    pub(super) fn rates(&self) -> Option<(f64, f64)> {
        Some((
            self.pace(|report| report.updates)?,
            self.pace(|report| report.env_steps)?,
        ))
    }

    fn pace(&self, count: impl Fn(&LearnerReport) -> u64) -> Option<f64> {
        if self.reported.elapsed() > SPAN {
            return None;
        }
        let ((then, old), (now, new)) = (self.recent.front()?, self.recent.back()?);
        per_second((*then, count(old)), (*now, count(new)))
    }
}
