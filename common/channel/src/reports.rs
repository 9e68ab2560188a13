//! Reports, from every role to the launcher. They never hold a role up: where nobody reads, the oldest are lost.

use std::fmt::Debug;

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::service::header::publish_subscribe::Header;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use shoal_base::report::{EpisodeReport, EvaluatedReport, EvaluationReport, Heartbeat, LearnerReport};

use super::domain::Domain;
use super::error::ChannelError;
use super::memory;
use super::service::{Entry, Held, claim, service_name};

/// Reports a reader has in hand: each is copied and let go.
const BORROWED: usize = 1;

/// Reports a sender has in hand.
const LOANED: usize = 1;

/// A kind of report: its channel, and how many may wait to be read.
pub trait Report: Copy + Debug + ZeroCopySend + 'static {
    /// The channel's name.
    const CHANNEL: &'static str;
    /// Reports of one sender that may wait; older ones give way.
    const BUFFER: usize;
    /// Reports that a reader who comes late is still given.
    const HISTORY: usize;
    /// Readers there may be: the launcher, the learner, and one more to look on.
    const READERS: usize = 3;

    /// Opens the sending end, as [`Reporter::open`] does.
    #[doc(hidden)]
    fn sender(domain: &Domain) -> Result<Box<dyn Sender<Self>>, ChannelError>;

    /// Opens the reading end, as [`Reports::open`] does.
    #[doc(hidden)]
    fn receiver(domain: &Domain) -> Result<Box<dyn Receiver<Self>>, ChannelError>;
}

/// Declares a kind of report. Its ports are compiled here, and not once more in each crate that sends or reads it: a port
/// brings half a megabyte of iceoryx2 with it.
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
    // As many environments as an actor can have: a time limit ends all their episodes at the same step.
    const BUFFER: usize = 4096;
    const HISTORY: usize = 0;
    // The launcher alone: each further one would cost every actor 370 KB.
    const READERS: usize = 1;
}

report! { EvaluationReport:
    const CHANNEL: &'static str = "reports/evaluations";
    const BUFFER: usize = 64;
    const HISTORY: usize = 2;
}

report! { EvaluatedReport:
    const CHANNEL: &'static str = "reports/judged";
    const BUFFER: usize = 8;
    // A learner in lockstep that was restarted waits for it.
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
    /// When shared memory cannot be had.
    pub fn open(domain: &Domain) -> Result<Self, ChannelError> {
        R::sender(domain).map(Self)
    }

    /// Sends a report. One that cannot be sent is lost: reports must not stop the work they report on.
    pub fn send(&self, report: R) {
        self.0.send(report);
    }

    /// Hands the newest reports to readers that have come since. To be called while waiting.
    pub fn look_after(&self) {
        self.0.look_after();
    }
}

impl<R: Report> Reports<R> {
    /// Opens the reading end.
    ///
    /// # Errors
    /// When shared memory cannot be had.
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

/// What a [`Reporter`] does, whatever port it has.
#[doc(hidden)]
pub trait Sender<R>: Debug {
    fn send(&self, report: R);
    fn look_after(&self);
}

/// What [`Reports`] do, whatever port they have.
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

    fn look_after(&self) {
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
    claim(|| {
        service::<R>(domain, Entry::Open)?
            .publisher_builder()
            .max_loaned_samples(LOANED)
            .create()
            .map_err(|cause| ChannelError::new(R::CHANNEL, "report", cause))
    })
}

fn subscriber<R: Report>(domain: &Domain) -> Result<Subscriber<ipc::Service, R, ()>, ChannelError> {
    claim(|| {
        service::<R>(domain, Entry::Open)?
            .subscriber_builder()
            .create()
            .map_err(|cause| ChannelError::new(R::CHANNEL, "read", cause))
    })
}

/// Bytes of shared memory that reports of kind `R` reserve in a run of up to so many actors, with so many senders.
pub fn reserved<R: Report>(max_actors: usize, senders: usize) -> u64 {
    let samples = R::READERS * (R::BUFFER + BORROWED) + R::HISTORY + LOANED;
    let sender = memory::segment::<Header, ()>(samples, size_of::<R>())
        + R::READERS as u64 * memory::connection(1, R::BUFFER, BORROWED, samples);
    memory::service(2 * parties(max_actors)) + senders as u64 * sender
}

fn parties(max_actors: usize) -> usize {
    2 * max_actors + 8
}

/// Makes the service of reports of kind `R`.
pub(super) fn create<R: Report>(domain: &Domain) -> Result<Held, ChannelError> {
    let service = service::<R>(domain, Entry::Create)?;
    Ok(Held::new(move |see| {
        let ports = service.dynamic_config();
        ports.list_publishers(|port| see(port.node_id, port.publisher_id.value()));
        ports.list_subscribers(|port| see(port.node_id, port.subscriber_id.value()));
    }))
}

fn service<R: Report>(domain: &Domain, entry: Entry) -> Result<PortFactory<ipc::Service, R, ()>, ChannelError> {
    let parties = parties(domain.max_actors());
    let builder = domain
        .node()
        .service_builder(&service_name(domain, R::CHANNEL)?)
        .publish_subscribe::<R>()
        .max_publishers(parties)
        .max_subscribers(R::READERS)
        .max_nodes(parties)
        .enable_safe_overflow(true)
        .history_size(R::HISTORY)
        .subscriber_max_buffer_size(R::BUFFER)
        .subscriber_max_borrowed_samples(BORROWED);
    entry.service(R::CHANNEL, builder, |b| b.create(), |b| b.open())
}
