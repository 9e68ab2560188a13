//! The conversation between one actor and its environment server. A request carries one action for each environment, a
//! response what came of them; observations are read where the server wrote them. A snapshot of the episodes under way
//! comes back as words, from which any server of this environment goes on.

use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::request_response::PortFactory;

use super::{ChannelError, Domain, service_name};

mod client;
mod message;
mod port;

pub use client::{EnvironmentClient, Observed, Snapshot, Stepped};
pub use message::{Ask, RequestHeader, ResponseHeader, ResponseLayout, StepBlocks};
pub use port::{EnvironmentPort, Request};

fn name(index: u32) -> String {
    format!("env/{index}")
}

type EnvironmentService = PortFactory<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>;

/// One client, one server: the port is the claim.
fn service(domain: &Domain, channel: &str) -> Result<EnvironmentService, ChannelError> {
    domain
        .node()
        .service_builder(&service_name(domain, channel)?)
        .request_response::<[f32], [f32]>()
        .request_user_header::<RequestHeader>()
        .response_user_header::<ResponseHeader>()
        .max_clients(1)
        .max_servers(1)
        .max_nodes(8)
        .max_active_requests_per_client(4)
        .max_loaned_requests(2)
        .max_response_buffer_size(2)
        // The observation acted on is held until its transition is written.
        .max_borrowed_responses_per_pending_response(4)
        .open_or_create()
        .map_err(|cause| ChannelError::new(channel, "open", cause))
}
