//! `[reward]`: how rewards of the environment are prepared for networks that learn from minibatches.

use shoal_base::section;
use shoal_base::section::{above, never};

section! {
    /// How rewards are prepared for learning. The replay, curves and evaluations have the environment's.
    pub struct RewardConfig {
        /// The factor of every reward in a minibatch.
        scale: f64 = 1.0, bounds: above(0.0, 1e6), unit: "–", source: "ours",
            change: never("the critics have learned with it");
    }
}
