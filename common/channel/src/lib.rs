//! The typed channels between the processes of a run. Each flow of data has one module, which declares its service's
//! name, payload, header and limits. Both ends are made from that declaration.

mod cleanup;
pub mod commit;
pub mod control;
mod descriptor;
mod domain;
pub mod environment;
mod error;
mod event;
mod files;
mod heartbeat;
mod membership;
mod memory;
pub mod policy;
pub mod reports;
mod service;
mod services;
pub mod transitions;

pub use cleanup::Sweeper;
pub use domain::{Domain, DomainError};
pub use error::{ChannelError, ChannelErrorKind, PeerError};
pub use event::{EventName, Listener, Notifier, wait_for};
pub use heartbeat::HeartbeatSender;
pub use memory::free_shared_memory;
pub use service::PORT_TIMEOUT;
pub use services::Services;
