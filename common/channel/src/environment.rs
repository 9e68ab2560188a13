//! The conversation between one actor and its environment server. A request carries one action for each environment, a
//! response what came of them; observations are read where the server wrote them. A snapshot of the episodes under way
//! comes back as words, from which any server of this environment goes on.

mod check;
mod client;
mod message;
mod port;
mod service;

pub use check::Fault;
pub use client::{Begin, EnvironmentClient, Observed, Snapshot, Stepped, describe};
pub use message::{Ask, RequestHeader, ResponseHeader, ResponseLayout, StepBlocks};
pub use port::{EnvironmentPort, Request};
pub(super) use service::create;
pub use service::reserved;
