//! `[replay]`.

use shoal_base::numbers::COUNTER_LIMIT;
use shoal_base::section;
use shoal_base::section::{Change, OutOfRange, from, in_free_runs, never};

use crate::algorithms::{AlgorithmConfig, TransitionUse};

/// Most transitions in a replay.
const MAX_ROWS: u64 = 1_000_000_000;

section! {
    /// The replay, and the ratio of updates to environment steps.
    pub struct ReplayConfig {
        /// Minibatches are sampled from this many newest transitions.
        capacity: u64 = 1_000_000, bounds: from(1, MAX_ROWS), unit: "transitions", source: "section 4.3.1",
            change: never("the file of the replay has this size");
        /// Transitions collected before the first update.
        warmup: u64 = 1_000, bounds: from(0, MAX_ROWS), unit: "transitions", source: "ours",
            change: in_free_runs("its rounds so far have had the updates that it allows");
        /// Updates for each environment step beyond the warm-up: gradient steps, or rows for algorithms that use each
        /// row once. The thesis has 1.
        updates_per_step: f64 = 1.0, bounds: from(0.0, 1_000.0),
            unit: "updates per environment step", source: "Algorithm 4",
            change: in_free_runs("its replay is as large as it requires");
        /// n, steps of a transition: the sum of n discounted rewards, and the observation after the last of them.
        n_step: u32 = 1, bounds: from(1, 100), unit: "steps", source: "Sutton and Barto 2018, chapter 7",
            change: never("the rows in the replay were made with it");
        /// Environment steps that the actors may be ahead of that ratio before the learner stops taking transitions.
        tolerance: u64 = 512, bounds: from(1, MAX_ROWS), unit: "environment steps", source: "ours",
            change: Change::Anytime;
        /// The environment step at which the ratio was last changed. The ratio counts from there, or from the end of
        /// the warm-up if that is later. 0 if it was never changed.
        #[serde(skip_serializing_if = "is_zero")]
        ratio_since: u64 = 0, bounds: from(0, COUNTER_LIMIT), unit: "environment steps", source: "ours",
            change: Change::ByProgram;
        /// Updates that the ratio allowed up to `ratio_since`.
        #[serde(skip_serializing_if = "is_zero")]
        updates_before: u64 = 0, bounds: from(0, COUNTER_LIMIT), unit: "updates", source: "ours", change: Change::ByProgram;
    }
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde requires this signature")]
fn is_zero(number: &u64) -> bool {
    *number == 0
}

/// The ratio of updates to environment steps: the formulas that learner, launcher and records share. Neither the
/// learner nor the actors may get ahead of the ratio. An update is a gradient step or, for algorithms that use each row
/// once, a row.
impl ReplayConfig {
    /// The environment step after which the ratio counts.
    pub fn ratio_start(&self) -> u64 {
        self.warmup.max(self.ratio_since)
    }

    /// The updates that the ratio allows in total after `rows` environment steps.
    pub fn allowed_updates(&self, rows: u64) -> u64 {
        let counted = rows.saturating_sub(self.ratio_start());
        self.updates_before + (counted as f64 * self.updates_per_step) as u64
    }

    /// Whether a learner with `updates` updates is more than the tolerance behind `rows` environment steps, so that it
    /// must not take more rows.
    pub fn learner_is_behind(&self, rows: u64, updates: u64) -> bool {
        let rows = rows.saturating_sub(self.tolerance);
        rows > self.ratio_start() && self.allowed_updates(rows) > updates
    }

    /// Updates per environment step, both counted from [`ratio_start`](Self::ratio_start) on; `None` before.
    pub fn ratio(&self, updates: u64, env_steps: u64) -> Option<f64> {
        let steps = env_steps.saturating_sub(self.ratio_start());
        (steps > 0).then(|| updates.saturating_sub(self.updates_before) as f64 / steps as f64)
    }

    /// Checks every number for this algorithm.
    ///
    /// # Errors
    /// For the first invalid number.
    pub fn check(&self, algorithm: &AlgorithmConfig) -> Result<(), OutOfRange> {
        self.check_bounds("replay")?;
        let Self {
            capacity,
            warmup,
            updates_per_step,
            n_step,
            ..
        } = self;
        match algorithm.properties().transition_use {
            TransitionUse::Minibatches => {
                let least = algorithm.settings().batch() as u64;
                from(least, MAX_ROWS).check("replay.capacity", capacity)?;
                from(1, *capacity).check("replay.warmup", warmup)
            }
            TransitionUse::Transitions | TransitionUse::Episodes => {
                let only = |key: &str, value: String, only: &str| OutOfRange {
                    key: key.into(),
                    value,
                    expected: format!(
                        "{only}: {} learns from each step once, beginning with the first",
                        algorithm.name()
                    ),
                };
                if *warmup != 0 {
                    return Err(only("replay.warmup", warmup.to_string(), "0"));
                }
                if *n_step != 1 {
                    return Err(only("replay.n_step", n_step.to_string(), "1"));
                }
                if *updates_per_step != 1.0 {
                    return Err(only("replay.updates_per_step", updates_per_step.to_string(), "1"));
                }
                Ok(())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neither_side_gets_ahead_by_more_than_the_tolerance() {
        let replay = ReplayConfig {
            warmup: 100,
            updates_per_step: 0.5,
            tolerance: 10,
            ..ReplayConfig::default()
        };
        assert_eq!([100, 101, 102].map(|rows| replay.allowed_updates(rows)), [0, 0, 1]);
        assert!(!replay.learner_is_behind(111, 0), "the tolerance is not used up");
        assert!(replay.learner_is_behind(112, 0));
        assert!(!replay.learner_is_behind(112, 1));
        assert!(!replay.learner_is_behind(5, 0));
    }

    #[test]
    fn a_new_ratio_counts_from_the_step_of_its_change() {
        let before = ReplayConfig {
            warmup: 100,
            ..ReplayConfig::default()
        };
        let after = ReplayConfig {
            updates_per_step: 0.5,
            ratio_since: 1_100,
            updates_before: before.allowed_updates(1_100),
            ..before.clone()
        };
        assert_eq!((before.allowed_updates(100), before.allowed_updates(1_100)), (0, 1_000));
        assert_eq!(
            [1_000, 1_100, 1_102, 2_100].map(|rows| after.allowed_updates(rows)),
            [1_000, 1_000, 1_001, 1_500]
        );
        assert_eq!((before.ratio(500, 1_100), before.ratio(0, 100)), (Some(0.5), None));
        assert_eq!(after.ratio(1_050, 1_200), Some(0.5), "of the updates since then");
        assert_eq!(
            after.ratio(990, 1_200),
            Some(0.0),
            "the learner has some of the earlier ones to make"
        );
        let written = toml::to_string(&before).unwrap();
        assert!(
            !written.contains("ratio_since") && !written.contains("updates_before"),
            "{written}"
        );
    }
}
