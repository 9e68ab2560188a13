//! `[observation]`: how observations of the environment are prepared for networks that learn from minibatches.

use shoal_base::section;
use shoal_base::section::Change;

section! {
    /// How observations are prepared for networks. The replay holds the environment's.
    pub struct ObservationConfig {
        /// Whether each number is normalised by the mean and standard deviation of all observations so far. The learner
        /// keeps them and publishes them with the policy; they are part of checkpoints and exports.
        normalise: bool = false, unit: "–", source: "ours", change: Change::Shape;
    }
}
