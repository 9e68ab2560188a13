//! `[exploration]`: the noise that DDPG's actors add to the actions of their policy.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::section;
use shoal_base::section::{EXPLORATION, from};

section! {
    /// Ornstein-Uhlenbeck noise: x ← x − θ x + σ N(0, 1) at each step. It is added to the action in units of half the
    /// range.
    pub struct ExplorationConfig {
        /// θ, the pull towards zero.
        theta: f64 = 0.15, bounds: from(0.0, 1.0), unit: "1 / step", source: "section 4.3.1", change: EXPLORATION;
        /// σ, the size of each step's impulse.
        sigma: f64 = 0.2, bounds: from(0.0, 10.0), unit: "half action ranges", source: "section 4.3.1",
            change: EXPLORATION;
        /// How actors act until the learner's first update, while `replay.warmup` transitions are collected.
        warmup: Warmup = Warmup::Policy, unit: "–", source: "ours", change: EXPLORATION;
    }
}

/// How actors act before the first update.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Warmup {
    /// As later: the policy, here with its initial weights, and noise.
    Policy,
    /// Each element of an action is drawn uniformly from its range.
    Uniform,
}
