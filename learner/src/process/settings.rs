//! What a learner is told, and why it may not be able to go on.

use std::path::PathBuf;

use shoal_common::channel::ChannelError;
use shoal_common::config::{self, Mode};
use shoal_common::policy_file::PolicyFileError;
use shoal_common::report::Identity;
use shoal_common::space::EnvironmentSpec;
use shoal_common::transition::ChunkLayout;

use super::checkpoint::CheckpointError;
use super::intake::IntakeError;
use super::ratio::Ratio;
use crate::algorithms::algorithm::{Algorithm, Room, SectionError};
use crate::algorithms::registry::{self, AlgorithmError};
use crate::networks::threads::ThreadsError;
use crate::replay::{ReplayError, ReplayLayout};

/// What a learner is told.
#[derive(Clone, Debug)]
pub struct Settings {
    /// Which process this is.
    pub identity: Identity,
    /// The run's seed.
    pub seed: u64,
    /// Whether to take turns with the actors.
    pub mode: Mode,
    /// Environment steps after which training ends.
    pub steps: u64,
    /// Actors that take part.
    pub actors: u32,
    /// Actors there may ever be.
    pub max_actors: u32,
    /// Chunks an actor may have sent and not committed.
    pub window: u32,
    /// What a chunk has room for.
    pub chunk: ChunkLayout,
    /// What is controlled.
    pub spec: EnvironmentSpec,
    /// What is learned, and how.
    pub algorithm: config::Algorithm,
    /// Threads that share an update, 1 or 2.
    pub threads: u32,
    /// Environments of each actor.
    pub envs: u32,
    /// Episodes after which training ends, if that is before `steps`.
    pub episodes: Option<u64>,
    /// Updates per step.
    pub ratio: Ratio,
    /// Transitions that minibatches are sampled from.
    pub capacity: u64,
    /// When policies are judged.
    pub evaluation: config::Evaluation,
    /// The period of the policy that was judged last.
    pub judged: Option<u64>,
    /// When the state is saved.
    pub checkpoint: config::Checkpoint,
    /// Fingerprint of the run's configuration.
    pub fingerprint: u64,
    /// Where the replay lies.
    pub replay: PathBuf,
    /// Where checkpoints are kept.
    pub checkpoints: PathBuf,
    /// Where the policy is left at the end.
    pub last_policy: PathBuf,
}

/// Why a learner cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum LearnerError {
    /// A channel does not work.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// An actor sent what cannot be used.
    #[error(transparent)]
    Intake(#[from] IntakeError),
    /// The replay cannot be used.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// A checkpoint cannot be read or written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// A checkpoint is of another program.
    #[error(transparent)]
    Section(#[from] SectionError),
    /// The algorithm cannot learn this.
    #[error(transparent)]
    Algorithm(#[from] AlgorithmError),
    /// There is no second thread.
    #[error(transparent)]
    Threads(#[from] ThreadsError),
    /// The policy cannot be left behind.
    #[error(transparent)]
    PolicyFile(#[from] PolicyFileError),
    /// The weights are no numbers any more.
    #[error("the losses are no longer finite after {updates} updates: lower the learning rates or the rewards' scale")]
    Diverged {
        /// Updates done.
        updates: u64,
    },
    /// A lockstep run needs rows again that the ring has lost.
    #[error("{path}: the rows before row {needed} are gone, which the checkpoint needs again; start a new run")]
    RowsLost {
        /// The replay.
        path: PathBuf,
        /// The first row that is needed.
        needed: u64,
    },
}

impl Settings {
    /// Bytes that the learner's files need on the disk beyond what is there already; `None` where a replay so large is not
    /// possible, or nothing can be learned.
    pub fn disk_bytes(&self) -> Option<u64> {
        let replay = if self.replay.exists() {
            0
        } else {
            self.replay_layout().places()?.end as u64
        };
        let algorithm = self.method().ok()?;
        let checkpoint: usize = algorithm.state().iter().map(|(_, numbers)| numbers.len()).sum();
        // The latest, the one before it, and the next one while it is written; the best policy and the last likewise.
        let numbers = 3 * checkpoint + 3 * algorithm.policy().len();
        Some(replay + (size_of::<f32>() * numbers) as u64)
    }

    /// The learning method, before its first update.
    pub(super) fn method(&self) -> Result<Box<dyn Algorithm>, AlgorithmError> {
        let room = Room {
            capacity: self.capacity,
            chunk_rows: self.chunk.rows,
            actors: self.actors,
            envs: self.envs,
        };
        registry::new(&self.algorithm, &self.spec, self.seed, room)
    }

    /// What the replay of this run holds.
    pub(super) fn replay_layout(&self) -> ReplayLayout {
        ReplayLayout {
            row: self.chunk.row,
            ring: self.ring_rows(),
            actors: self.max_actors as usize,
            standing_words: self.chunk.standing_words,
            fingerprint: self.fingerprint,
        }
    }

    /// Rows the ring holds: the sampling window, and in lockstep the rows of two checkpoint intervals beyond it, because
    /// a learner that goes on from a checkpoint samples them again.
    fn ring_rows(&self) -> u64 {
        let slack = match self.mode {
            Mode::Free => 0,
            Mode::Lockstep => {
                // Without updates there are no checkpoints to go back to.
                let interval = self.checkpoint.every_updates as f64 / self.ratio.updates_per_step;
                let rows = if interval.is_finite() { 2.0 * interval } else { 0.0 };
                let round = self.chunk.rows as u64 * u64::from(self.actors);
                (rows as u64).saturating_add(2 * round)
            }
        };
        // A ring must have room for a chunk, however small the window.
        self.capacity.saturating_add(slack).max(self.chunk.rows as u64)
    }
}
