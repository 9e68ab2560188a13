//! What a learner is told, and why it may not be able to go on.

use std::path::PathBuf;

use shoal_common::channel::ChannelError;
use shoal_common::config::{Config, Mode};
use shoal_common::policy::PolicyError;
use shoal_common::policy_file::PolicyFileError;
use shoal_common::report::Identity;
use shoal_common::run_dir::RunDir;

use super::checkpoint::CheckpointError;
use super::intake::IntakeError;
use crate::algorithms::algorithm::SectionError;
use crate::algorithms::registry;
use crate::networks::threads::ThreadsError;
use crate::replay::{ReplayError, ReplayLayout};

/// What a learner is told.
#[derive(Clone, Debug)]
pub struct LearnerSettings {
    /// Which process this is.
    pub identity: Identity,
    /// The run's configuration.
    pub config: Config,
    /// The run's directory, where the replay, the checkpoints and the last policy are.
    pub run: RunDir,
    /// The period of the policy that was evaluated last.
    pub evaluated_period: Option<u64>,
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
    /// The algorithm cannot control the environment.
    #[error(transparent)]
    Algorithm(#[from] PolicyError),
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

/// Why the files of a run cannot have a size.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SizeError {
    /// The replay would be larger than a file can be.
    #[error("replay.capacity = {capacity}: no file can be so large; remember less")]
    Replay {
        /// Transitions that it should hold.
        capacity: u64,
    },
    /// All files together would be larger than can be counted.
    #[error("the run's files would have more than 2⁶⁴ bytes; remember less (replay.capacity = {capacity})")]
    Sum {
        /// Transitions that the replay should hold.
        capacity: u64,
    },
}

/// Bytes that the learner's files need on the disk beyond what is there already, for a run in the directory `run`.
///
/// # Errors
/// When a replay so large is not possible.
pub fn disk_bytes(config: &Config, run: &RunDir) -> Result<u64, SizeError> {
    let capacity = config.replay.capacity;
    let replay = if run.replay_file().exists() {
        0
    } else {
        let places = replay_layout(config).places().ok_or(SizeError::Replay { capacity })?;
        places.end as u64
    };
    let (_, policy) = config.algorithm.settings().learned(&config.spec).policy;
    // The latest, the one before it, and the next one while it is written; the best policy and the last likewise.
    let numbers = 3 * (registry::state_numbers(config) + policy.parameters()) as u64;
    let sum = numbers
        .checked_mul(size_of::<f32>() as u64)
        .and_then(|bytes| bytes.checked_add(replay));
    sum.ok_or(SizeError::Sum { capacity })
}

/// What the replay of a run holds.
pub fn replay_layout(config: &Config) -> ReplayLayout {
    let chunk = config.chunk_layout();
    ReplayLayout {
        row: chunk.row,
        ring: ring_rows(config),
        actors: config.actors.max as usize,
        actor_snapshot_words: chunk.actor_snapshot_words,
        fingerprint: config.fingerprint(),
    }
}

/// Rows the ring holds: the sampling window, and in lockstep the rows of two checkpoint intervals beyond it, because a learner
/// that goes on from a checkpoint samples them again.
fn ring_rows(config: &Config) -> u64 {
    let chunk = config.chunk_rows() as u64;
    let slack = match config.run.mode {
        Mode::Free => 0,
        Mode::Lockstep => {
            // Without updates there are no checkpoints to go back to.
            let interval = config.checkpoint.every_updates as f64 / config.replay.updates_per_step;
            let rows = if interval.is_finite() { 2.0 * interval } else { 0.0 };
            let round = chunk * u64::from(config.actors.count);
            (rows as u64).saturating_add(2 * round)
        }
    };
    // A ring must have room for a chunk, however small the window.
    config.replay.capacity.saturating_add(slack).max(chunk)
}
