//! The actor's end.

use iceoryx2::pending_response::PendingResponse;
use iceoryx2::port::client::Client;
use iceoryx2::prelude::*;
use iceoryx2::response::Response;

use super::message::{Ask, Block, RequestHeader, ResponseHeader, ResponseLayout, Verdict};
use super::{name, question_length, service};
use crate::channel::words::{numbers_of, words_of};
use crate::channel::{Bell, ChannelError, Domain, Interruption, Place, Ringer, claim, wait_for};
use crate::report::Role;
use crate::space::{EnvironmentSpec, Space};
use crate::stop::Stop;

/// Which episodes a reset begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Begin {
    /// The next one of each environment.
    Next,
    /// This one of each environment's own stream.
    Training(u64),
    /// Of environment `e`, the evaluation episode that far after this one.
    Evaluation(u64),
}

/// What an environment server can say to a step.
#[derive(Debug)]
pub enum Stepped {
    /// Every environment took the step.
    Taken(Observed),
    /// The server died, and another one has taken its place: the episodes under way are lost.
    Lost,
}

/// What an environment server can say when a snapshot is asked for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Snapshot {
    /// The words to restore from: as many as
    /// [`EnvironmentSpec::snapshot_words`](crate::space::EnvironmentSpec::snapshot_words) counts.
    Taken(Vec<u64>),
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
    snapshot_words: usize,
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

/// Asks environment server `index`, of which nothing is known, for its spaces and the number of its environments.
///
/// # Errors
/// When interrupted.
pub fn describe(
    domain: &Domain,
    index: u32,
    bell: &Bell,
    stop: Stop,
) -> Result<(EnvironmentSpec, usize), Interruption> {
    let unknown = Space::boxed(&[]);
    let spec = EnvironmentSpec {
        observation: unknown.clone(),
        action: unknown,
        time_limit: 0,
        state_width: 0,
    };
    EnvironmentClient::open(domain, index, &spec, 0, stop)?.describe(bell)
}

impl EnvironmentClient {
    /// Opens the conversation with environment server `index`, which is expected to step so many environments of this
    /// kind. Whether it does, [`describe`](Self::describe) tells. Waiting for an answer ends when `stop` is requested.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn open(
        domain: &Domain,
        index: u32,
        spec: &EnvironmentSpec,
        environments: usize,
        stop: Stop,
    ) -> Result<Self, ChannelError> {
        let channel = name(index);
        let snapshot_words = spec.snapshot_words(environments);
        let longest = question_length(spec, environments);
        let client = claim(|| {
            service(domain, &channel)?
                .client_builder()
                .initial_max_slice_len(longest)
                .create()
                .map_err(|cause| ChannelError::new(&channel, "ask", cause))
        })?;
        let ringer = Ringer::new(domain, Place(Role::EnvServer, index))?;
        Ok(Self {
            client,
            channel,
            ringer,
            layout: ResponseLayout::new(environments, spec.observation.width()),
            snapshot_words,
            stop,
        })
    }

    /// Asks the server for its spaces and the number of its environments.
    ///
    /// # Errors
    /// When interrupted.
    pub fn describe(&self, bell: &Bell) -> Result<(EnvironmentSpec, usize), Interruption> {
        let response = self.insist(bell, Ask::Describe, 0, &[])?;
        let (header, payload) = (response.user_header(), response.payload());
        let described = header.described(payload);
        described.ok_or_else(|| ChannelError::new(&self.channel, "describe", "the answer is too short").into())
    }

    /// Every environment begins an episode.
    ///
    /// # Errors
    /// When interrupted.
    pub fn reset(&self, bell: &Bell, begin: Begin) -> Result<Observed, Interruption> {
        let response = match begin {
            Begin::Next => self.insist(bell, Ask::Reset, 0, &[]),
            Begin::Training(episode) => self.insist(bell, Ask::ResetToTraining, episode, &[]),
            Begin::Evaluation(first) => self.insist(bell, Ask::ResetToEvaluation, first, &[]),
        }?;
        self.observed(response).map_err(Interruption::from)
    }

    /// Every environment takes a step with its action.
    ///
    /// # Errors
    /// When interrupted, or the server refuses the actions.
    pub fn step(&self, bell: &Bell, actions: &[f32]) -> Result<Stepped, Interruption> {
        match self.ask_within_episodes(bell, Ask::Step, actions)? {
            Some(response) => Ok(Stepped::Taken(self.observed(response)?)),
            None => Ok(Stepped::Lost),
        }
    }

    /// Asks for the training episodes under way, which stay as they are.
    ///
    /// # Errors
    /// When interrupted, or the server refuses: its environments cannot say their state, or run evaluation episodes.
    pub fn snapshot(&self, bell: &Bell) -> Result<Snapshot, Interruption> {
        let Some(response) = self.ask_within_episodes(bell, Ask::Snapshot, &[])? else {
            return Ok(Snapshot::Lost);
        };
        let words = words_of(self.answered(&response)?);
        if words.len() != self.snapshot_words {
            return Err(self.refused().into());
        }
        Ok(Snapshot::Taken(words))
    }

    /// Every environment goes on with its training episode of a snapshot; what to act on next is the answer, as after
    /// [`reset`](Self::reset).
    ///
    /// # Errors
    /// When interrupted, or the server refuses the words; it stays as it was then.
    pub fn restore(&self, bell: &Bell, words: &[u64]) -> Result<Observed, Interruption> {
        if words.len() != self.snapshot_words {
            let cause = format!("{} words for a snapshot of {}", words.len(), self.snapshot_words);
            return Err(ChannelError::new(&self.channel, "restore", cause).into());
        }
        let response = self.insist(bell, Ask::Restore, 0, numbers_of(words))?;
        self.observed(response).map_err(Interruption::from)
    }

    fn observed(&self, response: Answer) -> Result<Observed, ChannelError> {
        if self.answered(&response)?.len() != self.layout.len() {
            return Err(self.refused());
        }
        Ok(Observed {
            response,
            layout: self.layout,
        })
    }

    /// The payload of what is no refusal.
    fn answered<'a>(&self, response: &'a Answer) -> Result<&'a [f32], ChannelError> {
        if response.user_header().verdict == Verdict::Answered as u32 {
            Ok(response.payload())
        } else {
            Err(self.refused())
        }
    }

    fn refused(&self) -> ChannelError {
        ChannelError::new(&self.channel, "ask", "the environment server refused the request")
    }

    /// Asks once: for requests about the episodes under way. `None` when the server that ran them is no more.
    fn ask_within_episodes(&self, bell: &Bell, ask: Ask, payload: &[f32]) -> Result<Option<Answer>, Interruption> {
        let pending = self.send(ask, 0, payload)?;
        let answer = self.answer(bell, &pending)?;
        Ok(answer.filter(|response| response.user_header().verdict != Verdict::NotStarted as u32))
    }

    /// Asks until some server answers: for requests that may be asked twice.
    fn insist(&self, bell: &Bell, ask: Ask, episode: u64, payload: &[f32]) -> Result<Answer, Interruption> {
        loop {
            let pending = self.send(ask, episode, payload)?;
            if let Some(response) = self.answer(bell, &pending)? {
                return Ok(response);
            }
        }
    }

    fn send(&self, ask: Ask, episode: u64, payload: &[f32]) -> Result<Pending, ChannelError> {
        let failed = |cause: String| ChannelError {
            channel: self.channel.clone(),
            action: "ask",
            cause,
        };
        let mut request = self
            .client
            .loan_slice_uninit(payload.len())
            .map_err(|cause| failed(format!("{cause:?}")))?;
        *request.user_header_mut() = RequestHeader::new(ask, episode);
        let pending = request
            .write_from_slice(payload)
            .send()
            .map_err(|cause| failed(format!("{cause:?}")))?;
        self.ringer.ring();
        Ok(pending)
    }

    /// Waits for the answer; `None` when the server that was asked is no more.
    fn answer(&self, bell: &Bell, pending: &Pending) -> Result<Option<Answer>, Interruption> {
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
                // A dead server counts as connected until the launcher has cleaned up after it.
                lost.set(!pending.is_connected());
                Ok(())
            },
        )?;
        Ok(answer)
    }
}

type Pending = PendingResponse<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>;
type Answer = Response<ipc::Service, [f32], ResponseHeader>;
