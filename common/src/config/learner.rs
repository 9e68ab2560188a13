//! `[learner]`.

use shoal_base::section;
use shoal_base::section::from;

section! {
    /// With what is learned: no number that is learned depends on it.
    #[derive(Eq)]
    pub struct LearnerConfig {
        /// Threads that share the work of an update where there is enough of it, 1 or 2. Not a bit of what is learned depends
        /// on them.
        threads: u32 = 2, bounds: from(1, 2), unit: "threads", source: "ours";
    }
}
