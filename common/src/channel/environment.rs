//! The conversation between one actor and its environment server. A request carries one action for each environment, a
//! response what came of them; observations are read where the server wrote them.

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;
use iceoryx2::response::Response;
use iceoryx2::service::port_factory::request_response::PortFactory;

use super::{Bell, ChannelError, Domain, Interruption, Place, Ringer, claim, service_name, wait_for};
use crate::report::Role;
use crate::space::{EnvironmentSpec, Space};
use crate::stop::Stop;

/// What a request asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Ask {
    /// The spaces and the number of environments.
    Describe = 0,
    /// Every environment begins an episode of its own stream.
    Reset = 1,
    /// Environment `e` begins the evaluation episode `episode + e`, whose start is the same always and everywhere.
    ResetToEvaluation = 2,
    /// Every environment takes a step with its action.
    Step = 3,
}

/// Header of a request; its payload is the actions, environment after environment, for [`Ask::Step`], and empty otherwise.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
pub struct RequestHeader {
    ask: u32,
    reserved: u32,
    /// The first evaluation episode of [`Ask::ResetToEvaluation`].
    pub episode: u64,
}

/// How a request was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
enum Verdict {
    Answered = 0,
    /// A step before a reset: the server is not the one that the episode began with.
    NotStarted = 1,
    /// The request has the wrong length, or is of an unknown kind.
    Refused = 2,
}

/// Header of a response. The payload answers [`Ask::Describe`] with the least and greatest values of an observation and of
/// an action (for boxes), and everything else with the blocks of [`ResponseLayout`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
pub struct ResponseHeader {
    verdict: u32,
    /// Environments the server steps.
    pub environments: u32,
    /// Values of a discrete observation; 0 for a box.
    pub discrete_observations: u32,
    /// Numbers in an observation.
    pub observation_width: u32,
    /// Values of a discrete action; 0 for a box.
    pub discrete_actions: u32,
    /// Numbers in an action.
    pub action_width: u32,
    /// Steps after which an episode is truncated.
    pub time_limit: u32,
    reserved: u32,
}

/// Where the blocks of a response lie, each of them environment after environment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ResponseLayout {
    environments: usize,
    observation: usize,
}

/// The blocks of a response to [`Ask::Step`], to be written. A reset fills `observations` alone.
#[derive(Debug)]
pub struct StepBlocks<'a> {
    /// What to act on next: where an episode has ended, the first observation of the next one.
    pub observations: &'a mut [f32],
    /// The observation after the step, s', whether or not the episode ended with it.
    pub next_observations: &'a mut [f32],
    /// Reward of the step.
    pub rewards: &'a mut [f32],
    /// 1 where the step led to a terminal state, 0 elsewhere.
    pub terminated: &'a mut [f32],
    /// 1 where the time limit ended the episode, 0 elsewhere.
    pub truncated: &'a mut [f32],
}

/// What an environment server can say to a step.
#[derive(Debug)]
pub enum Stepped {
    /// Every environment took the step.
    Taken(Observed),
    /// The server died, and another one has taken its place: the episodes under way are lost.
    Lost,
}

/// A response in the server's memory.
#[derive(Debug)]
pub struct Observed {
    response: Response<ipc::Service, [f32], ResponseHeader>,
    layout: ResponseLayout,
}

/// The actor's end.
#[derive(Debug)]
pub struct EnvironmentClient {
    client: Client<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>,
    channel: String,
    ringer: Ringer,
    layout: ResponseLayout,
    stop: Stop,
}

/// The server's end.
#[derive(Debug)]
pub struct EnvironmentPort {
    server: Server<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>,
    channel: String,
    bell: Bell,
    ringer: Ringer,
    layout: ResponseLayout,
    spec: EnvironmentSpec,
}

/// A request that waits for its answer.
#[derive(Debug)]
pub struct Request<'a> {
    request: ActiveRequest<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>,
    port: &'a EnvironmentPort,
}

impl ResponseLayout {
    /// Blocks for so many environments with observations of this width.
    pub fn new(environments: usize, observation: usize) -> Self {
        Self {
            environments,
            observation,
        }
    }

    /// Numbers in a response.
    pub fn len(&self) -> usize {
        self.environments * (2 * self.observation + 3)
    }

    /// Whether a response holds nothing.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The blocks of a response of `len()` numbers.
    pub fn split_mut<'a>(&self, response: &'a mut [f32]) -> StepBlocks<'a> {
        let (observations, rest) = response.split_at_mut(self.environments * self.observation);
        let (next_observations, rest) = rest.split_at_mut(self.environments * self.observation);
        let (rewards, rest) = rest.split_at_mut(self.environments);
        let (terminated, rest) = rest.split_at_mut(self.environments);
        StepBlocks {
            observations,
            next_observations,
            rewards,
            terminated,
            truncated: &mut rest[..self.environments],
        }
    }
}

impl Observed {
    fn scalars(&self, block: usize) -> &[f32] {
        let ResponseLayout {
            environments,
            observation,
        } = self.layout;
        let start = environments * (2 * observation + block);
        &self.response.payload()[start..start + environments]
    }

    /// What to act on next, environment after environment: the columns of a batch.
    pub fn observations(&self) -> &[f32] {
        &self.response.payload()[..self.layout.environments * self.layout.observation]
    }

    /// What environment `e` is to act on next.
    pub fn observation(&self, e: usize) -> &[f32] {
        &self.response.payload()[e * self.layout.observation..][..self.layout.observation]
    }

    /// s' of environment `e`.
    pub fn next_observation(&self, e: usize) -> &[f32] {
        &self.response.payload()[(self.layout.environments + e) * self.layout.observation..][..self.layout.observation]
    }

    /// Reward of environment `e`.
    pub fn reward(&self, e: usize) -> f32 {
        self.scalars(0)[e]
    }

    /// Whether environment `e` reached a terminal state.
    pub fn terminated(&self, e: usize) -> bool {
        self.scalars(1)[e] != 0.0
    }

    /// Whether the time limit ended the episode of environment `e`.
    pub fn truncated(&self, e: usize) -> bool {
        self.scalars(2)[e] != 0.0
    }
}

impl EnvironmentClient {
    /// Opens the conversation with environment server `index` and learns what it serves; `place` is who rings back, and
    /// `environments` with `observation_width` what the server is expected to hold.
    ///
    /// # Errors
    /// When shared memory cannot be had, or the server serves something else.
    pub fn open(
        domain: &Domain,
        index: u32,
        layout: ResponseLayout,
        action_width: usize,
        stop: Stop,
    ) -> Result<Self, ChannelError> {
        let channel = name(index);
        let client = claim(domain, &channel, "ask", || {
            service(domain, &channel)?
                .client_builder()
                .initial_max_slice_len(layout.environments * action_width)
                .create()
                .map_err(|cause| ChannelError::new(&channel, "ask", cause))
        })?;
        let ringer = Ringer::new(domain, Place(Role::EnvServer, index))?;
        Ok(Self {
            client,
            channel,
            ringer,
            layout,
            stop,
        })
    }

    /// Asks the server for its spaces and the number of its environments.
    ///
    /// # Errors
    /// When interrupted.
    pub fn describe(&self, domain: &Domain, bell: &Bell) -> Result<(EnvironmentSpec, usize), Interruption> {
        let response = self.insist(domain, bell, Ask::Describe, 0)?;
        let header = response.user_header();
        let (observation, action) = (header.observation_width as usize, header.action_width as usize);
        let payload = response.payload();
        let space = |discrete: u32, start: usize, width: usize| {
            if discrete > 0 {
                return Some(Space::Discrete { n: discrete });
            }
            let low = payload.get(start..start + width)?.to_vec();
            let high = payload.get(start + width..start + 2 * width)?.to_vec();
            Some(Space::Box { low, high })
        };
        let actions_start = if header.discrete_observations > 0 {
            0
        } else {
            2 * observation
        };
        match (
            space(header.discrete_observations, 0, observation),
            space(header.discrete_actions, actions_start, action),
        ) {
            (Some(observation), Some(action)) => {
                let spec = EnvironmentSpec {
                    observation,
                    action,
                    time_limit: header.time_limit,
                };
                Ok((spec, header.environments as usize))
            }
            _ => Err(ChannelError::new(&self.channel, "describe", "the answer is too short").into()),
        }
    }

    /// Every environment begins a new episode; with `evaluation`, environment `e` begins the evaluation episode that far
    /// after the given one.
    ///
    /// # Errors
    /// When interrupted.
    pub fn reset(&self, domain: &Domain, bell: &Bell, evaluation: Option<u64>) -> Result<Observed, Interruption> {
        let response = match evaluation {
            None => self.insist(domain, bell, Ask::Reset, 0),
            Some(episode) => self.insist(domain, bell, Ask::ResetToEvaluation, episode),
        }?;
        self.observed(response).map_err(Interruption::from)
    }

    /// Every environment takes a step with its action.
    ///
    /// # Errors
    /// When interrupted, or the server refuses the actions.
    pub fn step(&self, domain: &Domain, bell: &Bell, actions: &[f32]) -> Result<Stepped, Interruption> {
        let pending = self.send(Ask::Step, 0, actions)?;
        let Some(response) = self.answer(domain, bell, &pending)? else {
            return Ok(Stepped::Lost);
        };
        if response.user_header().verdict == Verdict::NotStarted as u32 {
            return Ok(Stepped::Lost);
        }
        Ok(Stepped::Taken(self.observed(response)?))
    }

    fn observed(&self, response: Answer) -> Result<Observed, ChannelError> {
        if response.user_header().verdict != Verdict::Answered as u32 || response.payload().len() != self.layout.len() {
            return Err(ChannelError::new(
                &self.channel,
                "ask",
                "the environment server refused the request",
            ));
        }
        Ok(Observed {
            response,
            layout: self.layout,
        })
    }

    /// Asks until some server answers: for requests that may be asked twice.
    fn insist(&self, domain: &Domain, bell: &Bell, ask: Ask, episode: u64) -> Result<Answer, Interruption> {
        loop {
            let pending = self.send(ask, episode, &[])?;
            if let Some(response) = self.answer(domain, bell, &pending)? {
                return Ok(response);
            }
        }
    }

    fn send(&self, ask: Ask, episode: u64, actions: &[f32]) -> Result<Pending, ChannelError> {
        let failed = |cause: String| ChannelError {
            channel: self.channel.clone(),
            action: "ask",
            cause,
        };
        let mut request = self
            .client
            .loan_slice_uninit(actions.len())
            .map_err(|cause| failed(format!("{cause:?}")))?;
        *request.user_header_mut() = RequestHeader {
            ask: ask as u32,
            reserved: 0,
            episode,
        };
        let pending = request
            .write_from_slice(actions)
            .send()
            .map_err(|cause| failed(format!("{cause:?}")))?;
        self.ringer.ring();
        Ok(pending)
    }

    /// Waits for the answer; `None` when the server that was asked is no more.
    fn answer(&self, domain: &Domain, bell: &Bell, pending: &Pending) -> Result<Option<Answer>, Interruption> {
        let lost = std::cell::Cell::new(false);
        let answer = wait_for(
            bell,
            &self.stop,
            || match pending.receive() {
                Ok(Some(response)) => Ok(Some(Some(response))),
                Ok(None) if lost.get() => Ok(Some(None)),
                Ok(None) => Ok(None),
                Err(cause) => Err(ChannelError::new(&self.channel, "hear the answer", cause)),
            },
            || {
                // A dead server counts as connected until it is cleaned up.
                domain.clean();
                lost.set(!pending.is_connected());
                Ok(())
            },
        )?;
        Ok(answer)
    }
}

impl EnvironmentPort {
    /// The answering end of environment server `index`, which serves so many environments of this kind to `client`.
    ///
    /// # Errors
    /// When shared memory cannot be had, or another server lives at this place.
    pub fn open(
        domain: &Domain,
        index: u32,
        spec: EnvironmentSpec,
        environments: usize,
        client: Place,
    ) -> Result<Self, ChannelError> {
        let channel = name(index);
        let layout = ResponseLayout::new(environments, spec.observation.width());
        let described = 2 * (spec.observation.width() + spec.action.width());
        let server = claim(domain, &channel, "answer", || {
            service(domain, &channel)?
                .server_builder()
                .initial_max_slice_len(layout.len().max(described))
                .create()
                .map_err(|cause| ChannelError::new(&channel, "answer", cause))
        })?;
        let bell = Bell::hang(domain, Place(Role::EnvServer, index))?;
        let ringer = Ringer::new(domain, client)?;
        Ok(Self {
            server,
            channel,
            bell,
            ringer,
            layout,
            spec,
        })
    }

    /// Waits for the next request that is not answered here; `idle` is called at each pause.
    ///
    /// # Errors
    /// When interrupted.
    pub fn next(&self, stop: &Stop, mut idle: impl FnMut()) -> Result<Request<'_>, Interruption> {
        loop {
            let request = wait_for(
                &self.bell,
                stop,
                || {
                    self.server
                        .receive()
                        .map_err(|cause| ChannelError::new(&self.channel, "hear a request", cause))
                },
                || {
                    idle();
                    Ok(())
                },
            )?;
            let request = Request { request, port: self };
            match request.ask() {
                Some(Ask::Describe) => request.describe()?,
                Some(_) => return Ok(request),
                None => request.refuse()?,
            }
        }
    }
}

impl Request<'_> {
    /// What is asked; `None` for what this build does not know.
    pub fn ask(&self) -> Option<Ask> {
        let code = self.request.user_header().ask;
        [Ask::Describe, Ask::Reset, Ask::ResetToEvaluation, Ask::Step]
            .into_iter()
            .find(|ask| *ask as u32 == code)
    }

    /// The evaluation episode that environment 0 shall begin.
    pub fn episode(&self) -> u64 {
        self.request.user_header().episode
    }

    /// Answers with what `write` makes of the actions, environment after environment; where it fails, the request is
    /// refused, and the failure returned.
    ///
    /// # Errors
    /// When shared memory is exhausted.
    pub fn answer<E>(
        self,
        write: impl FnOnce(&[f32], StepBlocks<'_>) -> Result<(), E>,
    ) -> Result<Result<(), E>, ChannelError> {
        let layout = self.port.layout;
        let mut result = Ok(());
        self.respond(layout.len(), |payload| {
            result = write(self.request.payload(), layout.split_mut(payload));
            if result.is_ok() {
                Verdict::Answered
            } else {
                Verdict::Refused
            }
        })?;
        Ok(result)
    }

    /// Answers that no episode is under way.
    ///
    /// # Errors
    /// When shared memory is exhausted.
    pub fn not_started(self) -> Result<(), ChannelError> {
        self.respond(0, |_| Verdict::NotStarted)
    }

    /// Answers that the request makes no sense.
    ///
    /// # Errors
    /// When shared memory is exhausted.
    pub fn refuse(self) -> Result<(), ChannelError> {
        self.respond(0, |_| Verdict::Refused)
    }

    fn describe(self) -> Result<(), ChannelError> {
        let mut bounds = Vec::new();
        for space in [&self.port.spec.observation, &self.port.spec.action] {
            if let Space::Box { low, high } = space {
                bounds.extend(low);
                bounds.extend(high);
            }
        }
        self.respond(bounds.len(), |payload| {
            payload.copy_from_slice(&bounds);
            Verdict::Answered
        })
    }

    fn respond(&self, length: usize, write: impl FnOnce(&mut [f32]) -> Verdict) -> Result<(), ChannelError> {
        let EnvironmentPort {
            spec, layout, channel, ..
        } = self.port;
        let discrete = |space: &Space| if let Space::Discrete { n } = space { *n } else { 0 };
        let mut response = self
            .request
            .loan_slice(length)
            .map_err(|cause| ChannelError::new(channel, "answer", cause))?;
        let verdict = write(response.payload_mut());
        *response.user_header_mut() = ResponseHeader {
            verdict: verdict as u32,
            environments: layout.environments as u32,
            discrete_observations: discrete(&spec.observation),
            observation_width: spec.observation.width() as u32,
            discrete_actions: discrete(&spec.action),
            action_width: spec.action.width() as u32,
            time_limit: spec.time_limit,
            reserved: 0,
        };
        response
            .send()
            .map_err(|cause| ChannelError::new(channel, "answer", cause))?;
        self.port.ringer.ring();
        Ok(())
    }
}

type Pending = PendingResponse<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>;
type Answer = Response<ipc::Service, [f32], ResponseHeader>;

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
