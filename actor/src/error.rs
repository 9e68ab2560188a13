//! Why an actor or an evaluator cannot go on.

use shoal_common::channel::{ChannelError, Interruption};
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

/// Ends a role's loop: asked to, or for a reason.
pub(crate) enum Ended {
    Stopped,
    Failed(ActorError),
}

impl From<Interruption> for Ended {
    fn from(interruption: Interruption) -> Self {
        match interruption {
            Interruption::Stopped => Self::Stopped,
            Interruption::Channel(error) => Self::Failed(error.into()),
        }
    }
}

impl<E: Into<ActorError>> From<E> for Ended {
    fn from(error: E) -> Self {
        Self::Failed(error.into())
    }
}

impl Ended {
    /// Being asked to end is no failure.
    pub(crate) fn into_result(self) -> Result<(), ActorError> {
        match self {
            Self::Stopped => Ok(()),
            Self::Failed(error) => Err(error),
        }
    }
}
