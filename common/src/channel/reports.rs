//! Reports, from every role to the launcher. They never hold a role up: where nobody reads, the oldest are lost.

use std::fmt::Debug;

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::{ChannelError, Domain, claim, service_name};
use crate::report::{EpisodeReport, EvaluationReport, Heartbeat, LearnerReport};

/// A kind of report: its channel, and how many may wait to be read.
pub trait Report: Copy + Debug + ZeroCopySend + 'static {
    /// The channel's name.
    const CHANNEL: &'static str;
    /// Reports of one sender that may wait; older ones give way.
    const BUFFER: usize;
    /// Reports that a reader who comes late is still given.
    const HISTORY: usize;
}

impl Report for Heartbeat {
    const CHANNEL: &'static str = "reports/heartbeats";
    const BUFFER: usize = 8;
    const HISTORY: usize = 1;
}

impl Report for EpisodeReport {
    const CHANNEL: &'static str = "reports/episodes";
    const BUFFER: usize = 4096;
    const HISTORY: usize = 0;
}

impl Report for EvaluationReport {
    const CHANNEL: &'static str = "reports/evaluations";
    const BUFFER: usize = 64;
    // A learner in lockstep that was restarted needs the evaluation it was waiting for.
    const HISTORY: usize = 2;
}

impl Report for LearnerReport {
    const CHANNEL: &'static str = "reports/learner";
    const BUFFER: usize = 64;
    const HISTORY: usize = 1;
}

/// The sending end of one kind of report.
#[derive(Debug)]
pub struct Reporter<R: Report> {
    publisher: Publisher<ipc::Service, R, ()>,
}

/// The reading end of one kind of report, from all its senders.
#[derive(Debug)]
pub struct Reports<R: Report> {
    subscriber: Subscriber<ipc::Service, R, ()>,
}

impl<R: Report> Reporter<R> {
    /// Opens the sending end.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn open(domain: &Domain) -> Result<Self, ChannelError> {
        let publisher = claim(R::CHANNEL, "report", || {
            service::<R>(domain)?
                .publisher_builder()
                .create()
                .map_err(|cause| ChannelError::new(R::CHANNEL, "report", cause))
        })?;
        Ok(Self { publisher })
    }

    /// Sends a report. One that cannot be sent is lost: reports must not stop the work they report on.
    pub fn send(&self, report: R) {
        if let Err(cause) = self.publisher.send_copy(report) {
            tracing::debug!(?cause, channel = R::CHANNEL, "a report was lost");
        }
    }

    /// Hands the newest reports to readers that have come since. To be called while waiting.
    pub fn look_after(&self) {
        if let Err(cause) = self.publisher.update_connections() {
            tracing::debug!(?cause, channel = R::CHANNEL, "a reader was not connected");
        }
    }
}

impl<R: Report> Reports<R> {
    /// Opens the reading end.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn open(domain: &Domain) -> Result<Self, ChannelError> {
        let subscriber = claim(R::CHANNEL, "read", || {
            service::<R>(domain)?
                .subscriber_builder()
                .create()
                .map_err(|cause| ChannelError::new(R::CHANNEL, "read", cause))
        })?;
        Ok(Self { subscriber })
    }

    /// The next report, if there is one.
    ///
    /// # Errors
    /// When a sender's memory cannot be mapped.
    pub fn receive(&self) -> Result<Option<R>, ChannelError> {
        let received = self
            .subscriber
            .receive()
            .map_err(|cause| ChannelError::new(R::CHANNEL, "read", cause))?;
        Ok(received.map(|sample| *sample.payload()))
    }
}

fn service<R: Report>(domain: &Domain) -> Result<PortFactory<ipc::Service, R, ()>, ChannelError> {
    let parties = 2 * domain.max_actors() + 8;
    domain
        .node()
        .service_builder(&service_name(domain, R::CHANNEL)?)
        .publish_subscribe::<R>()
        .max_publishers(parties)
        .max_subscribers(3)
        .max_nodes(parties)
        .enable_safe_overflow(true)
        .history_size(R::HISTORY)
        .subscriber_max_buffer_size(R::BUFFER)
        .subscriber_max_borrowed_samples(1)
        .open_or_create()
        .map_err(|cause| ChannelError::new(R::CHANNEL, "open", cause))
}
