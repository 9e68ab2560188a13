//! `[learner]`.

use shoal_base::section;
use shoal_base::section::{Change, from};

section! {
    /// The learner's threads. They do not affect what is learned.
    #[derive(Eq)]
    pub struct LearnerConfig {
        /// Threads that share the work of an update if it is large enough, 1 or 2. The learned weights do not depend on
        /// it.
        threads: u32 = 2, bounds: from(1, 2), unit: "threads", source: "ours", change: Change::Anytime;
    }
}
