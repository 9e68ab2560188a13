//! The policy, from the learner to actors and evaluator; only the latest counts. Readers evaluate it in place, in the
//! learner's memory, and can use it even after the learner has died.
//!
//! ```
//! use shoal_channel::policy::{PolicyHeader, PolicyPublisher, PolicyReader};
//! use shoal_channel::{Domain, Services};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let run_id = format!("example-{}", std::process::id());
//! let domain = Domain::join(&run_id, 1)?; // a run of at most one actor
//! let mut services = Services::new(&domain)?; // as the launcher does
//! services.create_common(&domain)?;
//!
//! let fingerprint = 7; // of the parameters' layout
//! let learner = PolicyPublisher::open(&domain, 3)?;
//! let mut actor = PolicyReader::open(&domain, fingerprint, 3)?;
//! assert!(actor.latest()?.is_none());
//!
//! let header = PolicyHeader { version: 1, fingerprint, ..PolicyHeader::default() };
//! learner.publish(&[0.5, -1.0, 2.0], header)?;
//! let policy = actor.latest()?.ok_or("no policy")?;
//! assert_eq!(policy.header().version, 1);
//! assert_eq!(policy.parameters(), [0.5, -1.0, 2.0]);
//!
//! drop((policy, actor, learner, services));
//! domain.leave()?; // the last to leave removes the run from shared memory
//! # assert!(std::fs::read_dir("/dev/shm")?.flatten().all(|file| !file.file_name().to_string_lossy().contains(&run_id)));
//! # Ok(())
//! # }
//! ```

use std::rc::Rc;

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::service::header::publish_subscribe::Header;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::domain::Domain;
use super::error::{ChannelError, PeerError};
use super::memory;
use super::service::{HeldService, OpenMode, make_port, service_name};

const CHANNEL: &str = "policy";

/// Unread policies kept for each reader: the newest.
const BUFFER: usize = 1;

/// Policies that a reader holds at the same time: the current one, and the next one before the current is released.
const BORROWED: usize = 2;

/// The header of a policy.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
pub struct PolicyHeader {
    /// Incarnation of the learner that published it.
    pub incarnation: u64,
    /// Grows with each publication; a restarted learner continues from its checkpoint.
    pub version: u64,
    /// Environment steps that it was learned from.
    pub env_steps: u64,
    /// Updates that made it.
    pub updates: u64,
    /// Fingerprint of the parameters' layout.
    pub fingerprint: u64,
}

/// The learner's end.
#[derive(Debug)]
pub struct PolicyPublisher {
    publisher: Publisher<ipc::Service, [f32], PolicyHeader>,
}

/// A reader's end. It holds the newest policy that it has received.
#[derive(Debug)]
pub struct PolicyReader {
    subscriber: Subscriber<ipc::Service, [f32], PolicyHeader>,
    current: Option<Rc<PublishedPolicy>>,
    fingerprint: u64,
    parameters: usize,
}

/// A policy in the learner's memory. It stays valid and unchanged until this is dropped, even after the learner has
/// ended.
#[derive(Debug)]
pub struct PublishedPolicy {
    sample: Sample<ipc::Service, [f32], PolicyHeader>,
}

impl PolicyPublisher {
    /// Opens the publishing end for policies with this many parameters.
    ///
    /// # Errors
    /// When shared memory is unavailable, or another learner is alive.
    pub fn open(domain: &Domain, parameters: usize) -> Result<Self, ChannelError> {
        let samples = samples(domain.max_actors());
        let publisher = make_port(|| {
            service(domain, OpenMode::Open)?
                .publisher_builder()
                .initial_max_slice_len(parameters)
                .max_loaned_samples(1)
                .override_sample_preallocation(move |_| samples)
                .create()
                .map_err(|cause| ChannelError::new(CHANNEL, "publish", cause))
        })?;
        Ok(Self { publisher })
    }

    /// Publishes a policy.
    ///
    /// # Errors
    /// When shared memory is exhausted, or a connection fails.
    pub fn publish(&self, parameters: &[f32], header: PolicyHeader) -> Result<(), ChannelError> {
        let mut loan = self
            .publisher
            .loan_slice_uninit(parameters.len())
            .map_err(|cause| ChannelError::new(CHANNEL, "publish", cause))?;
        *loan.user_header_mut() = header;
        loan.write_from_slice(parameters)
            .send()
            .map(|_| ())
            .map_err(|cause| ChannelError::new(CHANNEL, "publish", cause))
    }

    /// Connects to new readers, which then receive the newest policy. Call this while waiting.
    ///
    /// # Errors
    /// When a connection fails.
    pub fn refresh_connections(&self) -> Result<(), ChannelError> {
        self.publisher
            .update_connections()
            .map_err(|cause| ChannelError::new(CHANNEL, "reconnect", cause))
    }
}

impl PolicyReader {
    /// Opens the reading end for policies whose layout has this fingerprint and number of parameters.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn open(domain: &Domain, fingerprint: u64, parameters: usize) -> Result<Self, ChannelError> {
        let subscriber = make_port(|| {
            service(domain, OpenMode::Open)?
                .subscriber_builder()
                .create()
                .map_err(|cause| ChannelError::new(CHANNEL, "read", cause))
        })?;
        Ok(Self {
            subscriber,
            current: None,
            fingerprint,
            parameters,
        })
    }

    /// The newest policy; the same one again if there is no newer, `None` before the first. Drop the previous policy
    /// before calling this again: a reader can hold at most two.
    ///
    /// # Errors
    /// When the learner's memory cannot be mapped, or its policy has another layout.
    pub fn latest(&mut self) -> Result<Option<Rc<PublishedPolicy>>, ChannelError> {
        while let Some(sample) = self
            .subscriber
            .receive()
            .map_err(|cause| ChannelError::new(CHANNEL, "read", cause))?
        {
            if sample.user_header().fingerprint != self.fingerprint || sample.payload().len() != self.parameters {
                return Err(ChannelError::new(CHANNEL, "read", PeerError::PolicyLayout));
            }
            self.current = Some(Rc::new(PublishedPolicy { sample }));
        }
        Ok(self.current.clone())
    }
}

impl PublishedPolicy {
    /// The policy's header.
    pub fn header(&self) -> &PolicyHeader {
        self.sample.user_header()
    }

    /// Its parameters, in the layout of the policy.
    pub fn parameters(&self) -> &[f32] {
        self.sample.payload()
    }
}

/// Bytes of shared memory that policies with this many parameters reserve in a run of up to `max_actors` actors. This
/// is twice what one learner needs, because the memory of a killed learner stays until the readers have a newer policy.
pub fn reserved(max_actors: usize, parameters: usize) -> u64 {
    let (samples, readers) = (samples(max_actors), readers(max_actors));
    let learner = memory::segment::<Header, PolicyHeader>(samples, size_of::<f32>() * parameters)
        + readers as u64 * memory::connection(1, BUFFER, BORROWED, samples);
    memory::service(readers + nodes(max_actors)) + 2 * learner
}

/// The evaluator, the actors, and one spare reader.
fn readers(max_actors: usize) -> usize {
    max_actors + 2
}

fn nodes(max_actors: usize) -> usize {
    max_actors + 4
}

/// Policies that can be in use at once: the policies that readers hold, the newest one, its replacement while that is
/// being published, and one being written. All readers share the newest; iceoryx2 alone would reserve one for each.
fn samples(max_actors: usize) -> usize {
    let (waiting, being_written) = (2, 1);
    readers(max_actors) * BORROWED + waiting + being_written
}

/// Creates the service.
pub(super) fn create(domain: &Domain) -> Result<HeldService, ChannelError> {
    service(domain, OpenMode::Create).map(HeldService::of_publish_subscribe)
}

fn service(domain: &Domain, mode: OpenMode) -> Result<PortFactory<ipc::Service, [f32], PolicyHeader>, ChannelError> {
    let builder = domain
        .node()
        .service_builder(&service_name(domain, CHANNEL)?)
        .publish_subscribe::<[f32]>()
        .user_header::<PolicyHeader>()
        .max_publishers(1)
        .max_subscribers(readers(domain.max_actors()))
        .max_nodes(nodes(domain.max_actors()))
        .enable_safe_overflow(true)
        .history_size(1)
        .subscriber_max_buffer_size(BUFFER)
        .subscriber_max_borrowed_samples(BORROWED);
    mode.service(CHANNEL, builder, |b| b.create(), |b| b.open())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_policy_can_be_published_while_every_reader_holds_two_different_ones() {
        const MAX_ACTORS: u32 = 3;
        let run_id = format!("{:x}", std::process::id());
        let domain = Domain::join(&run_id, MAX_ACTORS).unwrap();
        let service = create(&domain).unwrap();
        let publisher = PolicyPublisher::open(&domain, 100).unwrap();
        let readers: Vec<_> = (0..readers(MAX_ACTORS as usize))
            .map(|_| PolicyReader::open(&domain, 0, 100).unwrap().subscriber)
            .collect();
        let publish = |version| {
            let header = PolicyHeader {
                version,
                ..PolicyHeader::default()
            };
            publisher.publish(&[version as f32; 100], header).unwrap();
        };
        let mut held = Vec::new();
        let mut version = 0;
        for reader in readers.iter().flat_map(|reader| [reader; BORROWED]) {
            version += 1;
            publish(version);
            held.push((version, reader.receive().unwrap().unwrap()));
        }
        for further in 1..10 {
            publish(version + further);
        }
        for (version, sample) in &held {
            assert_eq!(sample.user_header().version, *version);
            assert_eq!(sample.payload(), [*version as f32; 100]);
        }
        drop((held, readers, publisher, service));
        domain.leave().unwrap();
    }
}
