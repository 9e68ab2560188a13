//! `[actors]`.

use shoal_base::section;
use shoal_base::section::{Change, OutOfRange, from, in_free_runs, never};
use shoal_base::space::MAX_ENVS;

section! {
    /// The actors, and the size of their chunks.
    #[derive(Eq)]
    pub struct ActorsConfig {
        /// Actor processes, each with its own environment server; at most `actors.max`, and at most 256.
        count: u32 = 2, unit: "processes", source: "ours", change: in_free_runs("its results depend on it");
        /// Environments that an actor steps at once.
        envs: u32 = 1, bounds: from(1, MAX_ENVS), unit: "environments", source: "ours",
            change: in_free_runs("saved states of its actors depend on it");
        /// Steps of every environment that are sent in one chunk. A chunk has `chunk_steps · envs` rows.
        chunk_steps: u32 = 8, bounds: from(1, ActorsConfig::MAX_CHUNK_STEPS), unit: "steps", source: "ours",
            change: in_free_runs("the length of a round depends on it");
        /// Chunks that an actor may have sent and the learner has not committed yet.
        window: u32 = 8, bounds: from(1, 64), unit: "chunks", source: "ours", change: Change::Anytime;
        /// The most actors that the run can be scaled to, on all hosts together.
        max: u32 = 16, bounds: from(1, ActorsConfig::MAX_ACTORS), unit: "processes", source: "ours",
            change: never("the replay has a place for each of them");
    }
}

impl ActorsConfig {
    /// The most actors on one host. Those with an index below this have a service of their own for their transitions on
    /// the learner's host. All others are on joined hosts, and share one.
    pub const MAX_ON_A_HOST: u32 = 256;

    /// The upper bound of `chunk_steps`.
    pub const MAX_CHUNK_STEPS: u32 = 4_096;

    /// The upper bound of `max`.
    pub const MAX_ACTORS: u32 = Self::MAX_ON_A_HOST + 1_024;

    /// Whether the actor with this index has a service of its own for its transitions on the learner's host.
    pub fn has_own_service(&self, actor: u32) -> bool {
        actor < self.max_on_a_host()
    }

    /// The most actors that one host may have.
    pub fn max_on_a_host(&self) -> u32 {
        self.max.min(Self::MAX_ON_A_HOST)
    }

    /// Checks a host's number of actors.
    ///
    /// # Errors
    /// Why a host cannot have this number.
    pub fn check_on_a_host(actors: u32) -> Result<(), String> {
        match actors {
            0 => Err("a host has at least 1 actor; to free it altogether, end its `shoal join`".into()),
            1..=Self::MAX_ON_A_HOST => Ok(()),
            _ => Err(format!("a host has at most {} actors", Self::MAX_ON_A_HOST)),
        }
    }

    /// Checks every number.
    ///
    /// # Errors
    /// For the first invalid number.
    pub fn check(&self) -> Result<(), OutOfRange> {
        self.check_bounds("actors")?;
        from(1, self.max_on_a_host()).check("actors.count", &self.count)
    }
}
