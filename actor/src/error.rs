//! Why an actor or an evaluator cannot go on.

use shoal_common::channel::ChannelError;
use shoal_common::commit::OpenError;
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
