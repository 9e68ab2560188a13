//! The service of an environment server: its name, its limits, and the memory that it reserves.

use iceoryx2::prelude::*;
use iceoryx2::service::header::request_response::{
    RequestHeader as IoxRequestHeader, ResponseHeader as IoxResponseHeader,
};
use iceoryx2::service::port_factory::request_response::PortFactory;
use shoal_base::packing::NUMBERS_PER_WORD;
use shoal_base::space::EnvironmentSpec;

use super::message::{RequestHeader, ResponseHeader, ResponseLayout};
use crate::domain::Domain;
use crate::error::ChannelError;
use crate::memory;
use crate::service::{HeldService, OpenMode, service_name};

/// Requests that may wait for a response: the current one, and requests that a killed server left unanswered.
const ACTIVE_REQUESTS: usize = 4;
const LOANED_REQUESTS: usize = 2;
/// Unread responses to one request.
const RESPONSE_BUFFER: usize = 2;
/// Responses that a client holds at the same time: it keeps the last observations until the transitions are written.
const BORROWED_RESPONSES: usize = 4;
pub(super) const LOANED_RESPONSES: usize = 2;
/// Processes that may have the service open.
const NODES: usize = 8;

/// Bytes of shared memory that the service of one server with this many environments like `spec` reserves.
pub fn reserved(spec: &EnvironmentSpec, environments: usize) -> u64 {
    // Twice: the server may still hold as many requests that the client has already given up.
    let requests = 2 * ACTIVE_REQUESTS + LOANED_REQUESTS;
    let of_a_request = RESPONSE_BUFFER + BORROWED_RESPONSES + LOANED_RESPONSES;
    let responses = 2 * ACTIVE_REQUESTS * of_a_request;
    let (request, response) = (request_length(spec, environments), response_length(spec, environments));
    memory::service(NODES)
        + memory::segment::<IoxRequestHeader, RequestHeader>(requests, size_of::<f32>() * request)
        + memory::segment::<IoxResponseHeader, ResponseHeader>(responses, size_of::<f32>() * response)
        + memory::connection(1, ACTIVE_REQUESTS, requests, requests)
        + memory::connection(2 * ACTIVE_REQUESTS, RESPONSE_BUFFER, BORROWED_RESPONSES, responses)
}

/// The most numbers in a request: the actions or a snapshot.
pub(super) fn request_length(spec: &EnvironmentSpec, environments: usize) -> usize {
    let snapshot = NUMBERS_PER_WORD * spec.snapshot_words(environments);
    (environments * spec.action.width()).max(snapshot)
}

/// The most numbers in a response: the blocks of [`ResponseLayout`], a description or a snapshot.
pub(super) fn response_length(spec: &EnvironmentSpec, environments: usize) -> usize {
    let described = 2 * (spec.observation.width() + spec.action.width());
    let snapshot = NUMBERS_PER_WORD * spec.snapshot_words(environments);
    let blocks = ResponseLayout::new(environments, spec.observation.width()).len();
    blocks.max(described).max(snapshot)
}

pub(super) fn name(index: u32) -> String {
    format!("env/{index}")
}

/// Creates the service of environment server `index`.
pub(crate) fn create(domain: &Domain, index: u32) -> Result<HeldService, ChannelError> {
    service(domain, &name(index), OpenMode::Create).map(HeldService::of_request_response)
}

pub(super) type EnvironmentService = PortFactory<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>;

/// Creates or opens the service. It admits one client and one server, so holding the port claims the role.
pub(super) fn service(domain: &Domain, channel: &str, mode: OpenMode) -> Result<EnvironmentService, ChannelError> {
    let builder = domain
        .node()
        .service_builder(&service_name(domain, channel)?)
        .request_response::<[f32], [f32]>()
        .request_user_header::<RequestHeader>()
        .response_user_header::<ResponseHeader>()
        .max_clients(1)
        .max_servers(1)
        .max_nodes(NODES)
        .max_active_requests_per_client(ACTIVE_REQUESTS)
        .max_loaned_requests(LOANED_REQUESTS)
        .max_response_buffer_size(RESPONSE_BUFFER)
        .max_borrowed_responses_per_pending_response(BORROWED_RESPONSES);
    mode.service(channel, builder, |b| b.create(), |b| b.open())
}
