//! Reports, from every role to the launcher. They never block a role: if nobody reads them, the oldest are lost.

use std::fmt::Debug;

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::service::header::publish_subscribe::Header;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use shoal_base::report::{EpisodeReport, EvaluatedPeriod, EvaluationReport, Heartbeat, LearnerReport};
use shoal_base::space::MAX_ENVS;

use super::domain::{Domain, participants};
use super::error::ChannelError;
use super::memory;
use super::service::{HeldService, OpenMode, make_port, service_name};

/// Reports that a reader holds at the same time: each is copied and released.
const BORROWED: usize = 1;

/// Reports that a sender holds at the same time.
const LOANED: usize = 1;

/// A kind of report: its channel and the limits of that channel.
pub trait Report: Copy + Debug + ZeroCopySend + 'static {
    /// The channel's name.
    const CHANNEL: &'static str;
    /// Unread reports kept for each sender; a newer one replaces the oldest.
    const BUFFER: usize;
    /// Old reports that a late reader still receives.
    const HISTORY: usize;
    /// Maximum number of readers: the launcher, the learner, and one observer.
    const READERS: usize = 3;

    /// Opens the sending end, as [`Reporter::open`] does.
    #[doc(hidden)]
    fn sender(domain: &Domain) -> Result<Box<dyn Sender<Self>>, ChannelError>;

    /// Opens the reading end, as [`Reports::open`] does.
    #[doc(hidden)]
    fn receiver(domain: &Domain) -> Result<Box<dyn Receiver<Self>>, ChannelError>;
}

/// Declares a kind of report. Its ports are compiled in this crate alone. Compiled again in each crate that uses them,
/// they would take another half a megabyte each.
macro_rules! report {
    ($report:ty: $($constants:tt)*) => {
        impl Report for $report {
            $($constants)*

            fn sender(domain: &Domain) -> Result<Box<dyn Sender<Self>>, ChannelError> {
                Ok(Box::new(publisher::<Self>(domain)?))
            }

            fn receiver(domain: &Domain) -> Result<Box<dyn Receiver<Self>>, ChannelError> {
                Ok(Box::new(subscriber::<Self>(domain)?))
            }
        }
    };
}

report! { Heartbeat:
    const CHANNEL: &'static str = "reports/heartbeats";
    const BUFFER: usize = 8;
    const HISTORY: usize = 1;
}

report! { EpisodeReport:
    const CHANNEL: &'static str = "reports/episodes";
    // A time limit ends the episodes of all environments of an actor at the same step.
    const BUFFER: usize = MAX_ENVS as usize;
    const HISTORY: usize = 0;
    // The launcher alone: each further reader would cost every actor 370 KB.
    const READERS: usize = 1;
}

report! { EvaluationReport:
    const CHANNEL: &'static str = "reports/evaluations";
    const BUFFER: usize = 64;
    const HISTORY: usize = 2;
}

report! { EvaluatedPeriod:
    const CHANNEL: &'static str = "reports/evaluated-periods";
    const BUFFER: usize = 8;
    // A restarted lockstep learner waits for the last report.
    const HISTORY: usize = 1;
}

report! { LearnerReport:
    const CHANNEL: &'static str = "reports/learner";
    const BUFFER: usize = 64;
    const HISTORY: usize = 1;
}

/// The sending end of one kind of report.
#[derive(Debug)]
pub struct Reporter<R: Report>(Box<dyn Sender<R>>);

/// The reading end of one kind of report, from all its senders.
#[derive(Debug)]
pub struct Reports<R: Report>(Box<dyn Receiver<R>>);

impl<R: Report> Reporter<R> {
    /// Opens the sending end.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn open(domain: &Domain) -> Result<Self, ChannelError> {
        R::sender(domain).map(Self)
    }

    /// Sends a report. A report that cannot be sent is lost, because reports must not stop a role's work.
    pub fn send(&self, report: R) {
        self.0.send(report);
    }

    /// Connects to new readers, which then receive the newest reports. Call this while waiting.
    pub fn refresh_connections(&self) {
        self.0.refresh_connections();
    }
}

impl<R: Report> Reports<R> {
    /// Opens the reading end.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn open(domain: &Domain) -> Result<Self, ChannelError> {
        R::receiver(domain).map(Self)
    }

    /// The next report, if there is one.
    ///
    /// # Errors
    /// When a sender's memory cannot be mapped.
    pub fn receive(&self) -> Result<Option<R>, ChannelError> {
        self.0.next()
    }
}

/// The port of a [`Reporter`], whatever its type.
#[doc(hidden)]
pub trait Sender<R>: Debug {
    fn send(&self, report: R);
    fn refresh_connections(&self);
}

/// The port of [`Reports`], whatever its type.
#[doc(hidden)]
pub trait Receiver<R>: Debug {
    fn next(&self) -> Result<Option<R>, ChannelError>;
}

impl<R: Report> Sender<R> for Publisher<ipc::Service, R, ()> {
    fn send(&self, report: R) {
        if let Err(cause) = self.send_copy(report) {
            tracing::debug!(?cause, channel = R::CHANNEL, "a report was lost");
        }
    }

    fn refresh_connections(&self) {
        if let Err(cause) = self.update_connections() {
            tracing::debug!(?cause, channel = R::CHANNEL, "a reader was not connected");
        }
    }
}

impl<R: Report> Receiver<R> for Subscriber<ipc::Service, R, ()> {
    fn next(&self) -> Result<Option<R>, ChannelError> {
        let received = self
            .receive()
            .map_err(|cause| ChannelError::new(R::CHANNEL, "read", cause))?;
        Ok(received.map(|sample| *sample.payload()))
    }
}

fn publisher<R: Report>(domain: &Domain) -> Result<Publisher<ipc::Service, R, ()>, ChannelError> {
    make_port(|| {
        service::<R>(domain, OpenMode::Open)?
            .publisher_builder()
            .max_loaned_samples(LOANED)
            .create()
            .map_err(|cause| ChannelError::new(R::CHANNEL, "report", cause))
    })
}

fn subscriber<R: Report>(domain: &Domain) -> Result<Subscriber<ipc::Service, R, ()>, ChannelError> {
    make_port(|| {
        service::<R>(domain, OpenMode::Open)?
            .subscriber_builder()
            .create()
            .map_err(|cause| ChannelError::new(R::CHANNEL, "read", cause))
    })
}

/// Bytes of shared memory that reports of kind `R` reserve with `senders` senders, in a run of up to `max_actors`
/// actors.
pub fn reserved<R: Report>(max_actors: usize, senders: usize) -> u64 {
    let samples = R::READERS * (R::BUFFER + BORROWED) + R::HISTORY + LOANED;
    let sender = memory::segment::<Header, ()>(samples, size_of::<R>())
        + R::READERS as u64 * memory::connection(1, R::BUFFER, BORROWED, samples);
    memory::service(2 * participants(max_actors)) + senders as u64 * sender
}

/// Creates the service of reports of kind `R`.
pub(super) fn create<R: Report>(domain: &Domain) -> Result<HeldService, ChannelError> {
    service::<R>(domain, OpenMode::Create).map(HeldService::of_publish_subscribe)
}

fn service<R: Report>(domain: &Domain, mode: OpenMode) -> Result<PortFactory<ipc::Service, R, ()>, ChannelError> {
    let participants = participants(domain.max_actors());
    let builder = domain
        .node()
        .service_builder(&service_name(domain, R::CHANNEL)?)
        .publish_subscribe::<R>()
        .max_publishers(participants)
        .max_subscribers(R::READERS)
        .max_nodes(participants)
        .enable_safe_overflow(true)
        .history_size(R::HISTORY)
        .subscriber_max_buffer_size(R::BUFFER)
        .subscriber_max_borrowed_samples(BORROWED);
    mode.service(R::CHANNEL, builder, |b| b.create(), |b| b.open())
}
