//! The client: an actor or the evaluator asks its environment server for resets and steps.

use std::cell::{Cell, RefCell};
use std::num::NonZeroU32;
use std::time::Instant;

use iceoryx2::identifiers::UniqueServerId;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::prelude::*;
use iceoryx2::response::Response;
use shoal_base::exit::Exit;
use shoal_base::packing::{numbers_of, words_of};
use shoal_base::role::Role;
use shoal_base::space::{EnvironmentSpec, Space};
use shoal_base::stop::Stop;

use super::check::{EpisodeLengths, ResponseFault, ResponsePart, check_response};
use super::message::{Block, RequestHeader, RequestKind, ResponseHeader, ResponseLayout, ResponseStatus};
use super::service::{EnvironmentService, name, request_length, service};
use crate::domain::Domain;
use crate::error::{ChannelError, PeerError};
use crate::event::{EventName, Listener, Notifier, wait_for};
use crate::service::{OpenMode, PORT_TIMEOUT, make_port};

/// Which episodes a reset begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResetRequest {
    /// The next training episode of each environment.
    Next,
    /// The training episode with this number, of each environment's own stream.
    Training(u64),
    /// Evaluation episodes: environment `e` begins with episode `first + e`.
    Evaluation {
        /// Number of the first episode.
        first: u64,
        /// Number of episodes. An environment whose next episode would be beyond them is not reset again.
        episodes: NonZeroU32,
    },
}

/// The result of a step.
#[derive(Debug)]
pub enum StepResult {
    /// Every environment took the step.
    Taken(EnvironmentResponse),
    /// The server died and another one has taken its place: the current episodes are lost.
    Lost,
}

/// The result of a request for a snapshot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SnapshotResult {
    /// The words to restore from; their number is
    /// [`EnvironmentSpec::snapshot_words`](shoal_base::space::EnvironmentSpec::snapshot_words).
    Taken(Vec<u64>),
    /// The server died and another one has taken its place: the current episodes are lost.
    Lost,
}

/// A response in the server's memory.
#[derive(Debug)]
pub struct EnvironmentResponse {
    response: Response<ipc::Service, [f32], ResponseHeader>,
    layout: ResponseLayout,
}

/// The client. While it waits for a response, it calls `idle` some twenty times a second.
#[derive(Debug)]
pub struct EnvironmentClient {
    service: EnvironmentService,
    /// The server that runs the current episodes.
    episode_server: Cell<Option<UniqueServerId>>,
    episode_lengths: RefCell<EpisodeLengths>,
    client: Client<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>,
    channel: String,
    notifier: Notifier,
    spec: EnvironmentSpec,
    layout: ResponseLayout,
    snapshot_words: usize,
    stop: Stop,
}

impl EnvironmentResponse {
    fn block(&self, block: Block) -> &[f32] {
        self.layout.block(block, self.response.payload())
    }

    fn of_environment(&self, e: usize, block: Block) -> &[f32] {
        let block = self.block(block);
        let width = block.len() / self.layout.environments;
        &block[e * width..][..width]
    }

    /// The observations to act on next, environment after environment: the columns of a batch.
    pub fn observations(&self) -> &[f32] {
        self.block(Block::Observations)
    }

    /// The observation of environment `e` to act on next.
    pub fn observation(&self, e: usize) -> &[f32] {
        self.of_environment(e, Block::Observations)
    }

    /// The observation s' of environment `e` after the step.
    pub fn next_observation(&self, e: usize) -> &[f32] {
        self.of_environment(e, Block::NextObservations)
    }

    /// Reward of environment `e`.
    pub fn reward(&self, e: usize) -> f32 {
        self.block(Block::Rewards)[e]
    }

    /// Whether environment `e` reached a terminal state.
    pub fn terminated(&self, e: usize) -> bool {
        self.block(Block::Terminated)[e] != 0.0
    }

    /// Whether the time limit ended the episode of environment `e`.
    pub fn truncated(&self, e: usize) -> bool {
        self.block(Block::Truncated)[e] != 0.0
    }
}

/// Asks environment server `index` for its spaces and the number of its environments, when neither is known yet.
/// While it waits for the response, it calls `idle` about twenty times a second.
///
/// # Errors
/// When `stop` is requested, or the channel fails.
pub fn spec(
    domain: &Domain,
    index: u32,
    listener: &Listener,
    stop: Stop,
    idle: impl FnMut(),
) -> Result<(EnvironmentSpec, usize), Exit<ChannelError>> {
    let unknown = Space::boxed(&[]);
    let spec = EnvironmentSpec {
        observation: unknown.clone(),
        action: unknown,
        time_limit: 0,
        state_width: 0,
    };
    EnvironmentClient::open(domain, index, &spec, 0, stop)?.spec(listener, idle)
}

impl EnvironmentClient {
    /// Connects to environment server `index`, which is expected to step this many environments like `spec`; use
    /// [`spec`](Self::spec()) to verify it. Waiting for a response ends when `stop` is requested.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn open(
        domain: &Domain,
        index: u32,
        spec: &EnvironmentSpec,
        environments: usize,
        stop: Stop,
    ) -> Result<Self, ChannelError> {
        let channel = name(index);
        let snapshot_words = spec.snapshot_words(environments);
        let longest = request_length(spec, environments);
        let (service, client) = make_port(|| {
            let service = service(domain, &channel, OpenMode::Open)?;
            let client = service
                .client_builder()
                .initial_max_slice_len(longest)
                .create()
                .map_err(|cause| ChannelError::new(&channel, "ask", cause))?;
            Ok((service, client))
        })?;
        let notifier = Notifier::new(domain, EventName(Role::EnvServer, index))?;
        Ok(Self {
            service,
            episode_server: Cell::new(None),
            episode_lengths: RefCell::default(),
            client,
            channel,
            notifier,
            spec: spec.clone(),
            layout: ResponseLayout::new(environments, spec.observation.width()),
            snapshot_words,
            stop,
        })
    }

    /// Asks the server for its spaces and the number of its environments.
    ///
    /// # Errors
    /// When a stop is requested, the channel fails, the server refuses, or its response fits no spaces.
    pub fn spec(
        &self,
        listener: &Listener,
        mut idle: impl FnMut(),
    ) -> Result<(EnvironmentSpec, usize), Exit<ChannelError>> {
        let response = self.request_until_answered(
            listener,
            RequestHeader::new(RequestKind::Describe, 0, 0),
            &[],
            &mut idle,
        )?;
        let (header, payload) = (response.user_header(), self.accepted_payload(&response)?);
        let described = header.described(payload);
        described.ok_or_else(|| ChannelError::new(&self.channel, "describe", PeerError::DescriptionLength).into())
    }

    /// Every environment begins an episode.
    ///
    /// # Errors
    /// When a stop is requested, the channel fails, or the server refuses.
    pub fn reset(
        &self,
        listener: &Listener,
        request: ResetRequest,
        mut idle: impl FnMut(),
    ) -> Result<EnvironmentResponse, Exit<ChannelError>> {
        let header = match request {
            ResetRequest::Next => RequestHeader::new(RequestKind::Reset, 0, 0),
            ResetRequest::Training(episode) => RequestHeader::new(RequestKind::ResetToTraining, episode, 0),
            ResetRequest::Evaluation { first, episodes } => {
                RequestHeader::new(RequestKind::ResetToEvaluation, first, episodes.get())
            }
        };
        let (environments, limit) = (self.layout.environments, self.spec.time_limit);
        let lengths = match request {
            ResetRequest::Evaluation { episodes, .. } => EpisodeLengths::of_evaluation(environments, limit, episodes),
            ResetRequest::Next | ResetRequest::Training(_) => EpisodeLengths::of_training(environments, limit),
        };
        let response = self.request_until_answered(listener, header, &[], &mut idle)?;
        self.accept_episodes(response, lengths)
    }

    /// Every environment takes a step with its action.
    ///
    /// # Errors
    /// When a stop is requested, the channel fails, the server refuses the actions, it denies having begun the
    /// episodes, or its response is [invalid](ChannelError::fault). After an invalid response new episodes must be
    /// begun.
    pub fn step(
        &self,
        listener: &Listener,
        actions: &[f32],
        mut idle: impl FnMut(),
    ) -> Result<StepResult, Exit<ChannelError>> {
        match self.request_within_episodes(listener, RequestKind::Step, actions, &mut idle)? {
            Some(response) => {
                let next = self.accept_observations(response, ResponsePart::Step)?;
                self.episode_lengths
                    .borrow_mut()
                    .count(|e| next.terminated(e) || next.truncated(e))
                    .map_err(|fault| ChannelError::new(&self.channel, "ask", PeerError::Invalid(fault)))?;
                Ok(StepResult::Taken(next))
            }
            None => Ok(StepResult::Lost),
        }
    }

    /// Asks for a snapshot of the current training episodes, which are not changed by it.
    ///
    /// # Errors
    /// When a stop is requested, the channel fails, or the server refuses because its environments cannot save their
    /// state or run evaluation episodes.
    pub fn snapshot(&self, listener: &Listener, mut idle: impl FnMut()) -> Result<SnapshotResult, Exit<ChannelError>> {
        let Some(response) = self.request_within_episodes(listener, RequestKind::Snapshot, &[], &mut idle)? else {
            return Ok(SnapshotResult::Lost);
        };
        let words = words_of(self.accepted_payload(&response)?);
        if words.len() != self.snapshot_words {
            let cause = PeerError::SnapshotLength {
                found: words.len(),
                expected: self.snapshot_words,
            };
            return Err(ChannelError::new(&self.channel, "ask", cause).into());
        }
        Ok(SnapshotResult::Taken(words))
    }

    /// Every environment continues its training episode from a snapshot. The result has the observations to act on
    /// next, as after [`reset`](Self::reset).
    ///
    /// # Errors
    /// When a stop is requested, the channel fails, or the server refuses the words; the server is then unchanged.
    pub fn restore(
        &self,
        listener: &Listener,
        words: &[u64],
        mut idle: impl FnMut(),
    ) -> Result<EnvironmentResponse, Exit<ChannelError>> {
        if words.len() != self.snapshot_words {
            let cause = PeerError::SnapshotLength {
                found: words.len(),
                expected: self.snapshot_words,
            };
            return Err(ChannelError::new(&self.channel, "restore", cause).into());
        }
        let response = self.request_until_answered(
            listener,
            RequestHeader::new(RequestKind::Restore, 0, 0),
            numbers_of(words),
            &mut idle,
        )?;
        // Only the server knows how many steps the restored episodes have had, so the count begins at 0.
        let lengths = EpisodeLengths::of_training(self.layout.environments, self.spec.time_limit);
        self.accept_episodes(response, lengths)
    }

    /// Takes the response to a reset or restore, and notes which server runs the new episodes.
    fn accept_episodes(
        &self,
        response: ServerResponse,
        lengths: EpisodeLengths,
    ) -> Result<EnvironmentResponse, Exit<ChannelError>> {
        let server = response.origin();
        let observed = self.accept_observations(response, ResponsePart::Observations)?;
        self.episode_server.set(Some(server));
        self.episode_lengths.replace(lengths);
        Ok(observed)
    }

    fn accept_observations(
        &self,
        response: ServerResponse,
        part: ResponsePart,
    ) -> Result<EnvironmentResponse, ChannelError> {
        let numbers = self.accepted_payload(&response)?;
        if numbers.len() != self.layout.len() {
            let fault = ResponseFault::Length {
                found: numbers.len(),
                expected: self.layout.len(),
            };
            return Err(ChannelError::new(&self.channel, "ask", PeerError::Invalid(fault)));
        }
        check_response(&self.spec, &self.layout, numbers, part)
            .map_err(|fault| ChannelError::new(&self.channel, "ask", PeerError::Invalid(fault)))?;
        Ok(EnvironmentResponse {
            response,
            layout: self.layout,
        })
    }

    /// The payload of a response; an error if the server refused.
    fn accepted_payload<'a>(&self, response: &'a ServerResponse) -> Result<&'a [f32], ChannelError> {
        let status = response.user_header().status;
        if status == ResponseStatus::Answered as u32 {
            return Ok(response.payload());
        }
        if status == ResponseStatus::Invalid as u32 {
            let cause = PeerError::Invalid(ResponseFault::Reported);
            return Err(ChannelError::new(&self.channel, "ask", cause));
        }
        Err(self.refused())
    }

    fn refused(&self) -> ChannelError {
        ChannelError::new(&self.channel, "ask", PeerError::Refused)
    }

    /// Asks once: for requests about the current episodes. `None` if the server that ran them is gone.
    fn request_within_episodes(
        &self,
        listener: &Listener,
        kind: RequestKind,
        payload: &[f32],
        idle: &mut dyn FnMut(),
    ) -> Result<Option<ServerResponse>, Exit<ChannelError>> {
        let server = self.server();
        if server != self.episode_server.get() {
            return Ok(None);
        }
        let sent = self.send(server, RequestHeader::new(kind, 0, 0), payload)?;
        let Some(response) = self.receive_response(listener, &sent, idle)? else {
            return Ok(None);
        };
        if response.user_header().status != ResponseStatus::NotStarted as u32 {
            return Ok(Some(response));
        }
        if Some(response.origin()) == self.episode_server.get() {
            return Err(ChannelError::new(&self.channel, "ask", PeerError::EpisodesDenied).into());
        }
        Ok(None)
    }

    /// Asks until a server answers: for requests that may be sent twice.
    fn request_until_answered(
        &self,
        listener: &Listener,
        header: RequestHeader,
        payload: &[f32],
        idle: &mut dyn FnMut(),
    ) -> Result<ServerResponse, Exit<ChannelError>> {
        let mut unreachable = None;
        loop {
            let sent = self.send(self.server(), header, payload)?;
            if let Some(response) = self.receive_response(listener, &sent, idle)? {
                return Ok(response);
            }
            if sent.server.is_none() || sent.is_delivered() {
                unreachable = None;
            } else if unreachable.get_or_insert_with(Instant::now).elapsed() >= PORT_TIMEOUT {
                return Err(ChannelError::new(&self.channel, "ask", PeerError::NoConnection).into());
            }
        }
    }

    /// Sends a request to `server`, which must be looked up before this call: a server that is found later may not have
    /// received the request. If another server takes its place in between, the request counts as lost and is sent
    /// again.
    fn send(
        &self,
        server: Option<UniqueServerId>,
        header: RequestHeader,
        payload: &[f32],
    ) -> Result<Sent, ChannelError> {
        let mut request = self
            .client
            .loan_slice_uninit(payload.len())
            .map_err(|cause| ChannelError::new(&self.channel, "ask", cause))?;
        *request.user_header_mut() = header;
        let pending = request
            .write_from_slice(payload)
            .send()
            .map_err(|cause| ChannelError::new(&self.channel, "ask", cause))?;
        self.notifier.notify();
        Ok(Sent { pending, server })
    }

    /// Waits for the response; `None` if the server that was asked is gone or did not get the request.
    fn receive_response(
        &self,
        listener: &Listener,
        sent: &Sent,
        idle: &mut dyn FnMut(),
    ) -> Result<Option<ServerResponse>, Exit<ChannelError>> {
        let lost = Cell::new(false);
        let response = wait_for(
            listener,
            &self.stop,
            || match sent.pending.receive() {
                Ok(Some(response)) => Ok(Some(Some(response))),
                Ok(None) if lost.get() => Ok(Some(None)),
                Ok(None) => Ok(None),
                Err(cause) => Err(ChannelError::new(&self.channel, "receive the response", cause)),
            },
            || {
                idle();
                // A dead server is listed until the launcher has cleaned up after it. `is_connected` does not help: it
                // stays true while a response of the dead server is held, and the actor always holds one.
                lost.set(!sent.is_delivered() || self.server() != sent.server);
                Ok(())
            },
        )?;
        Ok(response)
    }

    /// The server that is connected to the service.
    fn server(&self) -> Option<UniqueServerId> {
        let mut found = None;
        self.service.dynamic_config().list_servers(|server| {
            found = Some(server.server_id);
            CallbackProgression::Stop
        });
        found
    }
}

/// A request that waits for its response.
struct Sent {
    pending: Pending,
    /// The server that was connected when it was sent.
    server: Option<UniqueServerId>,
}

impl Sent {
    fn is_delivered(&self) -> bool {
        self.pending.number_of_server_connections() > 0
    }
}

type Pending = PendingResponse<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>;
type ServerResponse = Response<ipc::Service, [f32], ResponseHeader>;
