//! The live line; or, where standard error is no terminal, a plain line for each evaluation.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{HumanDuration, ProgressBar, ProgressDrawTarget, ProgressStyle};
use shoal_common::config::{Config, ReplayConfig};
use shoal_common::message::say;
use shoal_common::report::{EvaluationReport, LearnerReport};
use shoal_common::run_dir::RunDir;
use shoal_run::numbers::thousands;
use shoal_run::records::rate::per_second;

use super::requests::waiting;
use super::supervisor::Supervisor;

/// The time over which rates are averaged.
const RATE_SPAN: Duration = Duration::from_secs(5);

/// Below this share of the configured ratio, the progress line explains why. Early in a run, the lead that the actors
/// may have lowers the ratio.
const NEARLY: f64 = 0.98;

/// Shows the progress of a run on standard error.
#[derive(Debug)]
pub(super) struct ProgressLine {
    bar: ProgressBar,
    /// Whether plain lines are printed instead of the bar.
    plain: bool,
    /// Whether the bar counts episodes rather than steps.
    counts_episodes: bool,
    replay: ReplayConfig,
    learner: Option<LearnerReport>,
    /// Reports of the last [`RATE_SPAN`].
    recent: std::collections::VecDeque<(Duration, LearnerReport)>,
    evaluated: Option<EvaluationReport>,
    /// When the learner's last report arrived.
    reported_at: Instant,
    drawn_at: Instant,
}

impl ProgressLine {
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
            plain: !quiet && !std::io::stderr().is_terminal(),
            counts_episodes: config.run.episodes.is_some(),
            replay: config.replay.clone(),
            learner: None,
            recent: [].into(),
            evaluated: None,
            reported_at: Instant::now(),
            drawn_at: Instant::now(),
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
        self.reported_at = Instant::now();
        self.recent.push_back((wall, *report));
        while self.recent.front().is_some_and(|(then, _)| wall - *then > RATE_SPAN) {
            self.recent.pop_front();
        }
    }

    /// Takes a report of the evaluator. One that `is_new` is printed where there is no live line.
    pub(super) fn set_evaluation(&mut self, report: &EvaluationReport, is_new: bool) {
        self.evaluated = Some(*report);
        if self.plain && is_new {
            say(self.evaluation_line(report));
        }
    }

    fn evaluation_line(&self, report: &EvaluationReport) -> String {
        let steps = thousands(report.env_steps);
        let all = thousands(self.bar.length().unwrap_or(0));
        let place = match (self.counts_episodes, self.learner) {
            (false, _) => format!("step {steps} of {all}"),
            (true, None) => format!("step {steps}"),
            (true, Some(learner)) => format!("step {steps} ({} of {all} episodes)", thousands(learner.episodes)),
        };
        let mut parts = vec![format!("return {:.2} ± {:.2}", report.return_mean, report.return_std)];
        if let Some((updates, env_steps)) = self.rates() {
            parts.push(format!("{updates:.0} updates/s, {env_steps:.0} steps/s"));
        }
        parts.extend(self.learner.and_then(|learner| self.time_left(&learner)));
        format!("{}: {place}, {}", self.bar.prefix(), parts.join(", "))
    }

    pub(super) fn set_message(&self, message: &'static str) {
        self.bar.set_message(message);
    }

    /// Prints a line, above the bar if that is shown.
    pub(super) fn print(&self, text: &str) {
        if self.plain {
            say(text);
        } else {
            self.bar.println(text);
        }
    }

    pub(super) fn clear(&self) {
        self.bar.finish_and_clear();
    }

    pub(super) fn draw(&mut self, supervisor: &Supervisor) {
        if self.drawn_at.elapsed() < Duration::from_millis(250) || self.bar.is_hidden() {
            return;
        }
        self.drawn_at = Instant::now();
        let Some(learner) = self.learner else { return };
        self.bar.set_position(self.done(&learner));
        self.bar.set_message(self.line(&learner, supervisor));
    }

    /// The lines: progress; last evaluation and rates; ratio and waiting role; restarts, if there were any. Each fits
    /// into 80 columns.
    fn line(&self, learner: &LearnerReport, supervisor: &Supervisor) -> String {
        let (done, all) = (self.done(learner), self.bar.length().unwrap_or(0));
        let unit = if self.counts_episodes { "episodes" } else { "steps" };
        let mut distance = vec![format!("{}/{} {unit}", thousands(done), thousands(all))];
        distance.extend(self.time_left(learner));
        let mut pace = Vec::new();
        if let Some(evaluated) = &self.evaluated {
            pace.push(format!("eval {:.2}", evaluated.return_mean));
        }
        let updates = thousands(learner.updates);
        match self.rates() {
            Some((rate, env_steps)) => pace.push(format!("{updates} updates, {rate:.0}/s · {env_steps:.0} steps/s")),
            None => pace.push(format!("{updates} updates")),
        }
        let waits = waiting(supervisor).map(|who| format!(", {who}")).unwrap_or_default();
        let ratio = format!(
            "{}{waits}",
            ratio_in_words(&self.replay, learner.updates, learner.env_steps)
        );
        let mut lines = vec![distance.join(" · "), pace.join(" · "), ratio];
        if supervisor.restarts() > 0 {
            lines.push(format!("{} restarts; see shoal.log", supervisor.restarts()));
        }
        lines.join("\n  ")
    }

    /// How long the rest takes at the present pace.
    fn time_left(&self, learner: &LearnerReport) -> Option<String> {
        let pace = self.pace(|report| self.done(report)).filter(|pace| *pace > 0.0)?;
        let left = self.bar.length().unwrap_or(0).saturating_sub(self.done(learner)) as f64 / pace;
        Some(format!("{} left", HumanDuration(Duration::from_secs_f64(left))))
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
        if self.reported_at.elapsed() > RATE_SPAN {
            return None;
        }
        let ((then, old), (now, new)) = (self.recent.front()?, self.recent.back()?);
        per_second((*then, count(old)), (*now, count(new)))
    }
}

/// The ratio of updates to environment steps beside the configured one, and why it is lower at first.
fn ratio_in_words(replay: &ReplayConfig, updates: u64, env_steps: u64) -> String {
    let configured = replay.updates_per_step;
    let Some(ratio) = replay.ratio(updates, env_steps) else {
        let (steps, warmup) = (thousands(env_steps), thousands(replay.ratio_start()));
        return format!("warm-up: {steps} of {warmup} steps, then ratio {configured:.2}");
    };
    let stated = format!("ratio {ratio:.2} of {configured:.2}");
    if ratio >= NEARLY * configured {
        return stated;
    }
    format!(
        "{stated} (rising: actors may be {} steps ahead)",
        thousands(replay.tolerance)
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ratio_that_is_still_low_is_explained() {
        let replay = ReplayConfig {
            warmup: 100,
            updates_per_step: 0.5,
            ..ReplayConfig::default()
        };
        let words = |updates, steps| ratio_in_words(&replay, updates, steps);
        assert_eq!(words(0, 64), "warm-up: 64 of 100 steps, then ratio 0.50");
        assert_eq!(
            words(90, 500),
            "ratio 0.23 of 0.50 (rising: actors may be 512 steps ahead)"
        );
        assert_eq!(words(196, 500), "ratio 0.49 of 0.50");
    }
}
