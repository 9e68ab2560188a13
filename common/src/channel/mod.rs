//! The typed channels between the processes of a run. Each flow of data is one module: its service's name, payload, header
//! and limits are declared there once, and both ends are made from that declaration.

use std::fmt::Debug;
use std::time::{Duration, Instant};

use iceoryx2::prelude::*;

mod bell;
mod cleanup;
pub mod control;
mod descriptor;
mod domain;
pub mod environment;
mod memory;
pub mod policy;
mod pulse;
pub mod reports;
mod services;
pub mod transitions;
mod words;

pub use bell::{Bell, Place, Ringer, wait_for};
pub use cleanup::Sweeper;
pub use domain::{Domain, DomainError};
pub use memory::free_shared_memory;
pub use pulse::Pulse;
pub use services::Services;
pub(crate) use words::NUMBERS_OF_A_WORD;

/// A channel does not work: its service or port cannot be had, or memory is exhausted.
#[derive(Debug, thiserror::Error)]
#[error("channel {channel}: cannot {action}: {cause}")]
pub struct ChannelError {
    /// Name of the channel within the run.
    pub channel: String,
    /// What was tried.
    pub action: &'static str,
    /// iceoryx2's reason.
    pub cause: String,
}

impl ChannelError {
    fn new(channel: impl Into<String>, action: &'static str, cause: impl Debug) -> Self {
        Self {
            channel: channel.into(),
            action,
            cause: format!("{cause:?}"),
        }
    }
}

/// Why a role's loop ends early.
#[derive(Debug, thiserror::Error)]
pub enum Interruption {
    /// The role was asked to end: no failure.
    #[error("asked to end")]
    Stopped,
    /// A channel does not work.
    #[error(transparent)]
    Channel(#[from] ChannelError),
}

/// How a process comes to a service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Entry {
    /// Makes it: for the run's host alone, through [`Services`].
    Create,
    /// Opens it. It is there before whoever opens it is started.
    Open,
}

/// How long a dead predecessor may occupy a port before we give up.
const CLAIM_PATIENCE: Duration = Duration::from_secs(5);

/// Opens a service and makes a port in it. A process that died may still hold the place until the launcher has cleaned up
/// after it. So: try again for a while.
fn claim<T>(mut attempt: impl FnMut() -> Result<T, ChannelError>) -> Result<T, ChannelError> {
    let deadline = Instant::now() + CLAIM_PATIENCE;
    loop {
        match attempt() {
            Err(_) if Instant::now() < deadline => std::thread::sleep(Duration::from_millis(5)),
            result => return result,
        }
    }
}

/// The service name of a channel; every process of the run and the ecosystem's tools see it under this name.
fn service_name(domain: &Domain, channel: &str) -> Result<ServiceName, ChannelError> {
    let name = format!("shoal/{}/{channel}", domain.run_id());
    ServiceName::new(&name).map_err(|cause| ChannelError::new(channel, "be named", cause))
}
