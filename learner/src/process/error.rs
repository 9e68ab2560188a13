//! Why a learner fails.

use std::path::PathBuf;

use shoal_common::channel::ChannelError;
use shoal_common::policy::PolicyError;
use shoal_common::policy_file::PolicyFileError;

use super::checkpoint::CheckpointError;
use super::intake::IntakeError;
use crate::algorithms::algorithm::StateArrayError;
use crate::networks::threads::ThreadsError;
use crate::replay::ReplayError;

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
    #[error(
        "learning has diverged: the losses are no longer finite after {updates} updates; lower the learning rates or \
             reward.scale"
    )]
    Diverged {
        /// Updates so far.
        updates: u64,
    },
    /// A lockstep run must repeat updates on rows that the ring no longer holds.
    #[error(
        "{path}: the checkpoint needs all rows from row {needed} on, and some of them are gone, probably after a power \
             loss; start a new run"
    )]
    RowsLost {
        /// The replay.
        path: PathBuf,
        /// The first row that is needed.
        needed: u64,
    },
}
