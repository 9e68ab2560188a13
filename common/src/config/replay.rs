//! `[replay]`.

use shoal_base::section;
use shoal_base::section::{OutOfRange, from};

use crate::algorithms::{Algorithm, Experience};

/// Most transitions in a replay.
const MAX_ROWS: u64 = 1_000_000_000;

section! {
    /// The replay, and the ratio of updates to environment steps.
    pub struct ReplayConfig {
        /// Minibatches are sampled from this many newest transitions.
        capacity: u64 = 1_000_000, bounds: from(1, MAX_ROWS), unit: "transitions", source: "section 4.3.1";
        /// Transitions collected before the first update.
        warmup: u64 = 1_000, bounds: from(0, MAX_ROWS), unit: "transitions", source: "ours";
        /// Updates for each environment step beyond the warm-up: gradient steps, or rows for methods that use each row
        /// once. The thesis has 1.
        updates_per_step: f64 = 1.0, bounds: from(0.0, 1_000.0),
            unit: "updates per environment step", source: "Algorithm 4";
        /// n, steps of a transition: the sum of n discounted rewards, and the observation after the last of them.
        n_step: u32 = 1, bounds: from(1, 100), unit: "steps", source: "Sutton and Barto 2018, chapter 7";
        /// Environment steps that the actors may be ahead of that ratio before the learner stops taking transitions.
        tolerance: u64 = 512, bounds: from(1, MAX_ROWS), unit: "environment steps", source: "ours";
    }
}

impl ReplayConfig {
    /// Checks every number for this algorithm.
    ///
    /// # Errors
    /// For the first invalid number.
    pub fn check(&self, algorithm: &Algorithm) -> Result<(), OutOfRange> {
        self.check_bounds("replay")?;
        let Self {
            capacity,
            warmup,
            updates_per_step,
            n_step,
            ..
        } = self;
        match algorithm.spec().experience {
            Experience::Minibatches => {
                let least = algorithm.settings().batch() as u64;
                from(least, MAX_ROWS).check("replay.capacity", capacity)?;
                from(1, *capacity).check("replay.warmup", warmup)
            }
            Experience::Transitions | Experience::Episodes => {
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
