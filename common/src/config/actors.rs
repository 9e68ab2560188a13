//! `[actors]`.

use shoal_base::section;
use shoal_base::section::{OutOfRange, from};

section! {
    /// Who explores, and in how large portions.
    #[derive(Eq)]
    pub struct ActorsConfig {
        /// Actor processes, each with an environment server of its own; at most `actors.max`.
        count: u32 = 2, unit: "processes", source: "ours";
        /// Environments an actor steps at once.
        envs: u32 = 1, bounds: from(1, 4_096), unit: "environments", source: "ours";
        /// Steps of every environment that travel in one chunk: a chunk has `chunk_steps · envs` rows.
        chunk_steps: u32 = 8, bounds: from(1, 4_096), unit: "steps", source: "ours";
        /// Chunks an actor may have sent that the learner has not yet committed.
        window: u32 = 8, bounds: from(1, 64), unit: "chunks", source: "ours";
        /// The most actors the run can be scaled to.
        max: u32 = 16, bounds: from(1, 256), unit: "processes", source: "ours";
    }
}

impl ActorsConfig {
    /// Whether every number makes sense.
    ///
    /// # Errors
    /// For the first one that does not.
    pub fn check(&self) -> Result<(), OutOfRange> {
        self.check_bounds("actors")?;
        from(1, self.max).check("actors.count", &self.count)
    }
}
