//! Why an actor or an evaluator cannot go on.

use shoal_common::channel::ChannelError;
use shoal_common::commit::OpenError;
use shoal_common::evaluator_state::EvaluatorStateError;
use shoal_common::policy::PolicyError;
use shoal_common::policy_file::PolicyFileError;

/// Why an actor or an evaluator cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum ActorError {
    /// A channel does not work.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The replay, whose commit record the actor follows, cannot be read.
    #[error(transparent)]
    Replay(#[from] OpenError),
    /// The best policy cannot be kept.
    #[error(transparent)]
    PolicyFile(#[from] PolicyFileError),
    /// What the evaluator left cannot be read.
    #[error(transparent)]
    EvaluatorState(#[from] EvaluatorStateError),
    /// What the evaluator leaves cannot be written.
    #[error("cannot write the evaluator's state: {0}; free some space or check the rights of the run directory")]
    State(std::io::Error),
    /// The policy cannot act in this environment.
    #[error(transparent)]
    Actions(#[from] PolicyError),
    /// The environment server serves something else than the run was configured for.
    #[error("environment server {index} serves {served}, the run's config.toml says {configured}")]
    Server {
        /// The server.
        index: u32,
        /// What it serves.
        served: String,
        /// What it should serve.
        configured: String,
    },
}
