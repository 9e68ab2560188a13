//! The actor's end.

use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::prelude::*;
use iceoryx2::response::Response;

use super::message::{Ask, Block, RequestHeader, ResponseHeader, ResponseLayout, Verdict};
use super::{name, service};
use crate::channel::{Bell, ChannelError, Domain, Interruption, Place, Ringer, claim, wait_for};
use crate::report::Role;
use crate::space::{EnvironmentSpec, Space};
use crate::stop::Stop;

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

impl Observed {
    fn block(&self, block: Block) -> &[f32] {
        self.layout.block(block, self.response.payload())
    }

    fn of_environment(&self, e: usize, block: Block) -> &[f32] {
        let block = self.block(block);
        let width = block.len() / self.layout.environments;
        &block[e * width..][..width]
    }

    /// What to act on next, environment after environment: the columns of a batch.
    pub fn observations(&self) -> &[f32] {
        self.block(Block::Observations)
    }

    /// What environment `e` is to act on next.
    pub fn observation(&self, e: usize) -> &[f32] {
        self.of_environment(e, Block::Observations)
    }

    /// s' of environment `e`.
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

impl EnvironmentClient {
    /// Opens the conversation with environment server `index`, whose responses are expected to have this layout. Whether
    /// they do, [`describe`](Self::describe) tells. Waiting for an answer ends when `stop` is requested.
    ///
    /// # Errors
    /// When shared memory cannot be had.
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
                    state_width: header.state_width as usize,
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
        *request.user_header_mut() = RequestHeader::new(ask, episode);
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

type Pending = PendingResponse<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>;
type Answer = Response<ipc::Service, [f32], ResponseHeader>;
