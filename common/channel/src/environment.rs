//! Requests and responses between one actor and its environment server. A request to step has one action for each
//! environment, and its response the outcomes; the actor reads observations where the server wrote them. A snapshot of
//! the current episodes is returned as words, from which any server of this environment can continue.

mod check;
mod client;
mod message;
mod port;
mod service;

pub use check::ResponseFault;
pub use client::{EnvironmentClient, EnvironmentResponse, ResetRequest, SnapshotResult, StepResult, spec};
pub use message::{RequestHeader, RequestKind, ResponseHeader, ResponseLayout, StepBlocks};
pub use port::{EnvironmentPort, Request};
pub(super) use service::create;
pub use service::reserved;
