//! A learner's settings and its errors.

use std::path::PathBuf;

use shoal_common::channel::ChannelError;
use shoal_common::config::{Config, Mode};
use shoal_common::durable::allocated_bytes;
use shoal_common::policy::PolicyError;
use shoal_common::policy_file::PolicyFileError;
use shoal_common::role::RoleInstance;
use shoal_common::run_dir::RunDir;

use super::checkpoint::{CheckpointError, Checkpoints};
use super::intake::IntakeError;
use crate::algorithms::algorithm::StateArrayError;
use crate::algorithms::registry;
use crate::networks::threads::ThreadsError;
use crate::replay::{ReplayError, ReplayLayout, unfinished_bytes};

/// The settings of a learner.
#[derive(Clone, Debug)]
pub struct LearnerSettings {
    /// Which process this is.
    pub instance: RoleInstance,
    /// The run's configuration.
    pub config: Config,
    /// The run's directory, where the replay, the checkpoints and the last policy are.
    pub run: RunDir,
    /// The period of the policy that was evaluated last.
    pub evaluated_period: Option<u64>,
}

/// Why a learner fails.
#[derive(Debug, thiserror::Error)]
pub enum LearnerError {
    /// A channel failed.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// An actor sent a chunk that cannot be used.
    #[error(transparent)]
    Intake(#[from] IntakeError),
    /// The replay cannot be used.
    #[error(transparent)]
    Replay(#[from] ReplayError),
    /// A checkpoint cannot be read or written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// A checkpoint was written by another version of the program.
    #[error(transparent)]
    StateArray(#[from] StateArrayError),
    /// The algorithm cannot control the environment.
    #[error(transparent)]
    Algorithm(#[from] PolicyError),
    /// The second thread cannot be started.
    #[error(transparent)]
    Threads(#[from] ThreadsError),
    /// The last policy cannot be written.
    #[error(transparent)]
    PolicyFile(#[from] PolicyFileError),
    /// A loss is not finite.
    #[error("the losses are no longer finite after {updates} updates: lower the learning rates or the rewards' scale")]
    Diverged {
        /// Updates: gradient steps, or consumed rows (`TransitionUse`).
        updates: u64,
    },
    /// A lockstep run must repeat updates on rows that the ring no longer holds.
    #[error("{path}: some rows from row {needed} on are gone, and the checkpoint needs them again; start a new run")]
    RowsLost {
        /// The replay.
        path: PathBuf,
        /// The first row that is needed.
        needed: u64,
    },
}

/// Why the files of a run would be too large.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SizeError {
    /// The replay would be larger than a file can be.
    #[error("replay.capacity = {capacity}: no file can be that large; reduce it")]
    Replay {
        /// Transitions that it should hold.
        capacity: u64,
    },
    /// All files together would be larger than can be counted.
    #[error("the run's files would have more than 2⁶⁴ bytes; reduce replay.capacity = {capacity}")]
    Sum {
        /// Transitions that the replay should hold.
        capacity: u64,
    },
}

/// Bytes that the learner's files and the best policy need on the disk beyond those that the run in the directory `run`
/// has already. A replay that exists is not counted, nor what a start that was killed has reserved for one.
///
/// # Errors
/// When the files would be too large.
pub fn disk_bytes(config: &Config, run: &RunDir) -> Result<u64, SizeError> {
    let capacity = config.replay.capacity;
    let replay = if matches!(run.replay_file().try_exists(), Ok(false)) {
        let offsets = replay_layout(config).offsets().ok_or(SizeError::Replay { capacity })?;
        (offsets.end as u64).saturating_sub(unfinished_bytes(&run.replay_file()))
    } else {
        0
    };
    let (_, policy) = config.learned().policy;
    // Three checkpoints: the latest, the one before, and the next one while it is written. Three policies: the best,
    // the last, and one while it is written.
    let numbers = 3 * (registry::state_numbers(config) + policy.parameters()) as u64;
    let there = Checkpoints::allocated_bytes(&run.checkpoints())
        + allocated_bytes(&run.best_policy())
        + allocated_bytes(&run.last_policy());
    let sum = numbers
        .checked_mul(size_of::<f32>() as u64)
        .and_then(|bytes| bytes.saturating_sub(there).checked_add(replay));
    sum.ok_or(SizeError::Sum { capacity })
}

/// The layout of a run's replay.
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

/// Rows in the ring: the sampling range and, in lockstep, the rows of two checkpoint intervals and two rounds, because
/// a learner that continues from a checkpoint samples them again.
fn ring_rows(config: &Config) -> u64 {
    let chunk = config.chunk_rows() as u64;
    let slack = match config.run.mode {
        Mode::Free => 0,
        Mode::Lockstep => {
            // Without updates there are no checkpoints to continue from.
            let interval = config.checkpoint.every_updates as f64 / config.replay.updates_per_step;
            let rows = if interval.is_finite() { 2.0 * interval } else { 0.0 };
            let round = chunk * u64::from(config.actors.count);
            (rows as u64).saturating_add(2 * round)
        }
    };
    // The ring must hold a chunk even if the window is smaller.
    config.replay.capacity.saturating_add(slack).max(chunk)
}
