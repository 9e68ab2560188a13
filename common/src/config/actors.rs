//! `[actors]`.

use shoal_base::section;
use shoal_base::section::{OutOfRange, from};

section! {
    /// The actors, and the size of their chunks.
    #[derive(Eq)]
    pub struct ActorsConfig {
        /// Actor processes, each with its own environment server; at most `actors.max`.
        count: u32 = 2, unit: "processes", source: "ours";
        /// Environments that an actor steps at once.
        envs: u32 = 1, bounds: from(1, 4_096), unit: "environments", source: "ours";
        /// Steps of every environment that are sent in one chunk. A chunk has `chunk_steps · envs` rows.
        chunk_steps: u32 = 8, bounds: from(1, 4_096), unit: "steps", source: "ours";
        /// Chunks that an actor may have sent and the learner has not committed yet.
        window: u32 = 8, bounds: from(1, 64), unit: "chunks", source: "ours";
        /// The most actors that the run can be scaled to.
        max: u32 = 16, bounds: from(1, 256), unit: "processes", source: "ours";
    }
}

impl ActorsConfig {
    /// Checks every number.
    ///
    /// # Errors
    /// For the first invalid number.
    pub fn check(&self) -> Result<(), OutOfRange> {
        self.check_bounds("actors")?;
        from(1, self.max).check("actors.count", &self.count)
    }
}
