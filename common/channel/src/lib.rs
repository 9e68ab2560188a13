//! The typed channels between the processes of a run. Each flow of data is one module: its service's name, payload, header
//! and limits are declared there once, and both ends are made from that declaration.

mod bell;
mod cleanup;
pub mod commit;
pub mod control;
mod descriptor;
mod domain;
pub mod environment;
mod error;
mod files;
mod memory;
pub mod policy;
mod pulse;
pub mod reports;
mod service;
mod services;
pub mod transitions;

pub use bell::{Listener, Notifier, Place, wait_for};
pub use cleanup::Sweeper;
pub use domain::{Domain, DomainError};
pub use error::{ChannelError, ChannelErrorKind, PeerError};
pub use memory::free_shared_memory;
pub use pulse::HeartbeatSender;
pub use services::Services;
