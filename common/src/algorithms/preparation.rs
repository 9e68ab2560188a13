//! `[observation]` and `[reward]`: how numbers of the environment are prepared for networks that learn from
//! minibatches.

use shoal_base::section;
use shoal_base::section::{Change, above, never};

section! {
    /// How observations are prepared for networks. The replay holds the environment's.
    pub struct ObservationConfig {
        /// Whether each number is normalised by the mean and standard deviation of all observations so far. The learner
        /// keeps them and publishes them with the policy; they are part of checkpoints and exports.
        normalise: bool = false, unit: "–", source: "ours", change: Change::Shape;
    }
}

section! {
    /// How rewards are prepared for learning. The replay, curves and evaluations have the environment's.
    pub struct RewardConfig {
        /// The factor of every reward in a minibatch.
        scale: f64 = 1.0, bounds: above(0.0, 1e6), unit: "–", source: "ours",
            change: never("the critics have learned with it");
    }
}
