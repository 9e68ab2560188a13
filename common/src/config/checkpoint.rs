//! `[checkpoint]`.

use shoal_base::section;
use shoal_base::section::{Change, from, in_free_runs};

section! {
    /// How often the learner's state is saved.
    pub struct CheckpointConfig {
        /// Seconds between checkpoints of a free run.
        every_seconds: f64 = 5.0, bounds: from(0.0, 86_400.0), unit: "s", source: "ours", change: Change::Anytime;
        /// Updates between checkpoints of a lockstep run: gradient steps, or rows for algorithms that use each row
        /// once.
        every_updates: u64 = 5_000, bounds: from(1, 1_000_000_000), unit: "updates", source: "ours",
            change: in_free_runs("its replay is as large as it requires");
    }
}
