//! The size of an actor's snapshot between two chunks. The actor reads and writes the snapshot; chunks and the replay
//! have room for it.

/// The parts of an actor's snapshot, in words (`u64`). They follow each other in this order, with one word more after
/// `environments`: the actor's step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActorSnapshotLayout {
    /// Words of the environments, as their server returns them.
    pub environments: usize,
    /// Numbers of the exploration's state, of all environments together.
    pub exploration: usize,
    /// Number of environments. Each has the return and the length of its episode.
    pub envs: usize,
    /// Words of rows that are in no chunk yet (`RowLayout::n_step_words`).
    pub n_step: usize,
}

impl ActorSnapshotLayout {
    /// Words in total, including the actor's step.
    pub fn words(&self) -> usize {
        let Self {
            environments,
            exploration,
            envs,
            n_step,
        } = self;
        environments + 1 + exploration + 2 * envs + n_step
    }
}
