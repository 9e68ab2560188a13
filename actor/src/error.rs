//! Why an actor or an evaluator fails.

use shoal_common::channel::ChannelError;
use shoal_common::commit::OpenError;
use shoal_common::evaluator_state::EvaluatorStateError;
use shoal_common::policy::PolicyError;
use shoal_common::policy_file::PolicyFileError;

/// Why an actor or an evaluator fails.
#[derive(Debug, thiserror::Error)]
pub enum ActorError {
    /// A channel failed.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The replay, whose commit record the actor follows, cannot be read.
    #[error(transparent)]
    Replay(#[from] OpenError),
    /// A policy cannot be written.
    #[error(transparent)]
    PolicyFile(#[from] PolicyFileError),
    /// The evaluator's state cannot be read.
    #[error(transparent)]
    EvaluatorState(#[from] EvaluatorStateError),
    /// The evaluator's state cannot be written.
    #[error("cannot write the evaluator's state: {0}; free some space or check the permissions of the run directory")]
    WriteEvaluatorState(std::io::Error),
    /// The policy cannot act in this environment.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// The snapshot in the replay does not fit the actor.
    #[error(
        "the actor's snapshot in the replay does not fit the run's configuration; was config/used.toml or replay.bin \
         edited or exchanged?"
    )]
    Snapshot,
    /// The environment server serves other environments than the run's configuration has.
    #[error(
        "environment server {index} does not serve the run's environment: {difference}; was the environment or its \
         program changed?"
    )]
    Server {
        /// Index of the environment server.
        index: u32,
        /// What differs, in words.
        difference: String,
    },
}
