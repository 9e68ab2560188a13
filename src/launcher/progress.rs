//! The live line.

use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use shoal_common::config::Config;
use shoal_common::report::{EvaluationReport, LearnerReport};
use shoal_common::run_dir::RunDir;

use super::crew::Crew;
use super::desk::waiting;

/// Rates are taken over so long.
const SPAN: Duration = Duration::from_secs(5);

/// Shows on standard error how far a run is; nothing where that is no terminal.
#[derive(Debug)]
pub(super) struct Progress {
    bar: ProgressBar,
    warmup: u64,
    updates_per_step: f64,
    learner: Option<LearnerReport>,
    /// Reports of the last [`SPAN`].
    recent: std::collections::VecDeque<(Duration, LearnerReport)>,
    evaluated: Option<EvaluationReport>,
    /// When the learner's last report came.
    heard: Instant,
    drawn: Instant,
}

impl Progress {
    pub(super) fn new(config: &Config, run: &RunDir, quiet: bool) -> Self {
        let target = if quiet {
            ProgressDrawTarget::hidden()
        } else {
            ProgressDrawTarget::stderr()
        };
        let bar = ProgressBar::with_draw_target(Some(config.run.steps), target);
        if let Ok(style) = ProgressStyle::with_template("{prefix:.bold} {bar:16.cyan/dim} {msg}") {
            bar.set_style(style.progress_chars("━━─"));
        }
        bar.set_prefix(run.name());
        bar.set_message("starting");
        Self {
            bar,
            warmup: config.replay.warmup,
            updates_per_step: config.replay.updates_per_step,
            learner: None,
            recent: [].into(),
            evaluated: None,
            heard: Instant::now(),
            drawn: Instant::now(),
        }
    }

    /// What the learner said last.
    pub(super) fn learner(&self) -> Option<&LearnerReport> {
        self.learner.as_ref()
    }

    /// What the evaluator said last.
    pub(super) fn evaluated(&self) -> Option<&EvaluationReport> {
        self.evaluated.as_ref()
    }

    pub(super) fn heard_learner(&mut self, report: &LearnerReport, wall: Duration) {
        self.learner = Some(*report);
        self.heard = Instant::now();
        self.recent.push_back((wall, *report));
        while self.recent.front().is_some_and(|(then, _)| wall - *then > SPAN) {
            self.recent.pop_front();
        }
    }

    pub(super) fn heard_evaluation(&mut self, report: &EvaluationReport) {
        self.evaluated = Some(*report);
    }

    pub(super) fn say(&self, message: &'static str) {
        self.bar.set_message(message);
    }

    pub(super) fn clear(&self) {
        self.bar.finish_and_clear();
    }

    pub(super) fn draw(&mut self, crew: &Crew) {
        if self.drawn.elapsed() < Duration::from_millis(250) || self.bar.is_hidden() {
            return;
        }
        self.drawn = Instant::now();
        let Some(learner) = self.learner else { return };
        self.bar.set_position(learner.env_steps);
        self.bar.set_message(self.line(&learner, crew));
    }

    /// How far it is and how good, below it how fast and who waits, and restarts if there were any: each fits 80 columns.
    fn line(&self, learner: &LearnerReport, crew: &Crew) -> String {
        let steps = self.bar.length().unwrap_or(0);
        let rates = self.rates();
        let mut outcome = vec![format!("{}/{} steps", thousands(learner.env_steps), thousands(steps))];
        if let Some((_, env_steps)) = rates.filter(|(_, env_steps)| *env_steps > 0.0) {
            let left = steps.saturating_sub(learner.env_steps) as f64 / env_steps;
            outcome.push(format!("{} left", HumanDuration(Duration::from_secs_f64(left))));
        }
        if let Some(evaluated) = &self.evaluated {
            outcome.push(format!("eval {:.1}", evaluated.return_mean));
        }
        let mut pace = vec![format!("{} updates", thousands(learner.updates))];
        if let Some((updates, env_steps)) = rates {
            pace[0] += &format!(", {updates:.0}/s");
            pace.push(format!("{env_steps:.0} steps/s"));
        }
        let beyond = learner.env_steps.saturating_sub(self.warmup);
        let ratio = if beyond > 0 {
            learner.updates as f64 / beyond as f64
        } else {
            0.0
        };
        let waits = waiting(crew).map(|who| format!(", {who}")).unwrap_or_default();
        pace.push(format!("ratio {ratio:.2} of {:.2}{waits}", self.updates_per_step));
        let mut lines = vec![outcome.join(" · "), pace.join(" · ")];
        if crew.restarts() > 0 {
            lines.push(format!("{} restarts; shoal.log says why", crew.restarts()));
        }
        lines.join("\n  ")
    }

    /// Updates and environment steps a second; `None` while the learner is not heard of.
    pub(super) fn rates(&self) -> Option<(f64, f64)> {
        if self.heard.elapsed() > SPAN {
            return None;
        }
        let ((then, old), (now, new)) = (self.recent.front()?, self.recent.back()?);
        let seconds = (*now - *then).as_secs_f64();
        let rate = |new: u64, old: u64| new.saturating_sub(old) as f64 / seconds;
        (seconds > 0.0).then(|| (rate(new.updates, old.updates), rate(new.env_steps, old.env_steps)))
    }
}

/// 120000 as 120,000.
pub(crate) fn thousands(number: u64) -> String {
    indicatif::HumanCount(number).to_string()
}
