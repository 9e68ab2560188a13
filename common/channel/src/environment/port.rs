//! The server: takes the requests of its client, and answers them.

use iceoryx2::active_request::ActiveRequest;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;
use shoal_base::exit::Exit;
use shoal_base::packing::{numbers_of, words_of};
use shoal_base::role::Role;
use shoal_base::space::{EnvironmentSpec, Space};
use shoal_base::stop::Stop;

use super::message::{RequestHeader, RequestKind, ResponseHeader, ResponseLayout, ResponseStatus, StepBlocks};
use super::service::{LOANED_RESPONSES, name, response_length, service};
use crate::domain::Domain;
use crate::error::ChannelError;
use crate::event::{EventName, Listener, Notifier, wait_for};
use crate::service::{OpenMode, make_port};

/// The server's end.
#[derive(Debug)]
pub struct EnvironmentPort {
    server: Server<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>,
    channel: String,
    listener: Listener,
    notifier: Notifier,
    layout: ResponseLayout,
    spec: EnvironmentSpec,
}

/// A received request that must be answered.
#[derive(Debug)]
pub struct Request<'a> {
    request: ActiveRequest<ipc::Service, [f32], RequestHeader, [f32], ResponseHeader>,
    port: &'a EnvironmentPort,
}

impl EnvironmentPort {
    /// Opens the end of environment server `index`, which serves this many environments like `spec` to `client`.
    ///
    /// # Errors
    /// When shared memory is unavailable, or another server with this index is alive.
    pub fn open(
        domain: &Domain,
        index: u32,
        spec: EnvironmentSpec,
        environments: usize,
        client: EventName,
    ) -> Result<Self, ChannelError> {
        let channel = name(index);
        let layout = ResponseLayout::new(environments, spec.observation.width());
        let longest = response_length(&spec, environments);
        let server = make_port(|| {
            service(domain, &channel, OpenMode::Open)?
                .server_builder()
                .initial_max_slice_len(longest)
                .max_loaned_responses_per_request(LOANED_RESPONSES)
                .create()
                .map_err(|cause| ChannelError::new(&channel, "answer", cause))
        })?;
        let listener = Listener::bind(domain, EventName(Role::EnvServer, index))?;
        let notifier = Notifier::new(domain, client)?;
        Ok(Self {
            server,
            channel,
            listener,
            notifier,
            layout,
            spec,
        })
    }

    /// Waits for the next request, and calls `idle` at each pause. Requests for a description and requests of an
    /// unknown kind are answered here.
    ///
    /// # Errors
    /// When `stop` is requested or the channel fails.
    pub fn next(&self, stop: &Stop, mut idle: impl FnMut()) -> Result<Request<'_>, Exit<ChannelError>> {
        loop {
            let request = wait_for(
                &self.listener,
                stop,
                || {
                    self.server
                        .receive()
                        .map_err(|cause| ChannelError::new(&self.channel, "receive a request", cause))
                },
                || {
                    idle();
                    Ok(())
                },
            )?;
            let request = Request { request, port: self };
            match request.kind() {
                Some(RequestKind::Describe) => request.describe()?,
                Some(_) => return Ok(request),
                None => request.refuse()?,
            }
        }
    }
}

impl Request<'_> {
    /// The kind of the request; `None` if this build does not know it.
    pub fn kind(&self) -> Option<RequestKind> {
        let code = self.request.user_header().kind;
        RequestKind::ALL.into_iter().find(|kind| *kind as u32 == code)
    }

    /// The evaluation episode that environment 0 must begin, or the training episode that each environment must begin.
    pub fn episode(&self) -> u64 {
        self.request.user_header().episode
    }

    /// The number of evaluation episodes, from [`episode`](Self::episode) on; `None` if there is no limit.
    pub fn episodes(&self) -> Option<u32> {
        Some(self.request.user_header().episodes).filter(|episodes| *episodes > 0)
    }

    /// Answers with the blocks that `write` fills from the actions, environment after environment. If `write` fails,
    /// the request is refused and the inner result is that error.
    ///
    /// # Errors
    /// When the response cannot be sent.
    pub fn respond<E>(
        self,
        write: impl FnOnce(&[f32], StepBlocks<'_>) -> Result<(), E>,
    ) -> Result<Result<(), E>, ChannelError> {
        let layout = self.port.layout;
        let mut result = Ok(());
        self.send_response(layout.len(), |payload| {
            result = write(self.request.payload(), layout.split_mut(payload));
            if result.is_ok() {
                ResponseStatus::Answered
            } else {
                ResponseStatus::Refused
            }
        })?;
        Ok(result)
    }

    /// The words of the snapshot to restore.
    pub fn snapshot_words(&self) -> Vec<u64> {
        words_of(self.request.payload())
    }

    /// Answers with the snapshot that `write` writes. If `write` fails, the request is refused and the inner result is
    /// that error.
    ///
    /// # Errors
    /// When the response cannot be sent.
    pub fn respond_with_snapshot<E>(
        self,
        write: impl FnOnce(&mut [u64]) -> Result<(), E>,
    ) -> Result<Result<(), E>, ChannelError> {
        let EnvironmentPort { spec, layout, .. } = self.port;
        let mut words = vec![0; spec.snapshot_words(layout.environments)];
        if let Err(error) = write(&mut words) {
            self.refuse()?;
            return Ok(Err(error));
        }
        let numbers = numbers_of(&words);
        self.send_response(numbers.len(), |payload| {
            payload.copy_from_slice(numbers);
            ResponseStatus::Answered
        })?;
        Ok(Ok(()))
    }

    /// Answers that no episode has begun.
    ///
    /// # Errors
    /// When the response cannot be sent.
    pub fn not_started(self) -> Result<(), ChannelError> {
        self.send_response(0, |_| ResponseStatus::NotStarted)
    }

    /// Answers that the request is invalid.
    ///
    /// # Errors
    /// When the response cannot be sent.
    pub fn refuse(self) -> Result<(), ChannelError> {
        self.send_response(0, |_| ResponseStatus::Refused)
    }

    fn describe(self) -> Result<(), ChannelError> {
        let mut bounds = Vec::new();
        for space in [&self.port.spec.observation, &self.port.spec.action] {
            match space {
                Space::Box { low, high } => {
                    bounds.extend(low);
                    bounds.extend(high);
                }
                Space::Discrete { start, .. } => bounds.push(*start as f32),
            }
        }
        self.send_response(bounds.len(), |payload| {
            payload.copy_from_slice(&bounds);
            ResponseStatus::Answered
        })
    }

    fn send_response(
        &self,
        length: usize,
        write: impl FnOnce(&mut [f32]) -> ResponseStatus,
    ) -> Result<(), ChannelError> {
        let EnvironmentPort {
            spec, layout, channel, ..
        } = self.port;
        let discrete = |space: &Space| if let Space::Discrete { n, .. } = space { *n } else { 0 };
        let mut response = self
            .request
            .loan_slice(length)
            .map_err(|cause| ChannelError::new(channel, "answer", cause))?;
        let status = write(response.payload_mut());
        *response.user_header_mut() = ResponseHeader {
            status: status as u32,
            environments: layout.environments as u32,
            discrete_observations: discrete(&spec.observation),
            observation_width: spec.observation.width() as u32,
            discrete_actions: discrete(&spec.action),
            action_width: spec.action.width() as u32,
            time_limit: spec.time_limit,
            state_width: spec.state_width as u32,
        };
        response
            .send()
            .map_err(|cause| ChannelError::new(channel, "answer", cause))?;
        self.port.notifier.notify();
        Ok(())
    }
}
