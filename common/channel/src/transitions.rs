//! Transitions, from one actor to the learner, in chunks of rows.
//!
//! An actor has a service of its own, unless its index is `ActorsConfig::MAX_ON_A_HOST` or more. Those actors, all on
//! joined hosts, share one service: the gate sends the chunks of all of them, and the learner commits them in that
//! order.
//!
//! An actor has at most `window` chunks sent but not committed. The service's history holds as many, and the learner's
//! buffer twice as many, because a new learner may receive a whole history that was committed before and a whole window
//! on top. So `send` never runs out of space, and chunks that a dead learner had not committed reach the next one.
//!
//! Chunks of a dead actor still arrive, before any chunk of its successor, if the learner was connected to it. A new
//! actor cannot know which chunks will still arrive. So it first sends an empty chunk, its [`Handshake`], and sends no
//! rows until that one is committed. Then the replay has all it will ever have of the predecessor, and the sequence
//! continues from there. The documentation of the crate `shoal_learner` has an example.

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::header::publish_subscribe::Header;
use iceoryx2::service::port_factory::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use shoal_base::exit::Exit;
use shoal_base::packing::{numbers_of, words_of};
use shoal_base::stop::Stop;
use shoal_base::transition::{ChunkLayout, Transition};

use super::domain::Domain;
use super::error::{ChannelError, PeerError};
use super::event::{Listener, wait_for};
use super::memory;
use super::service::{HeldService, OpenMode, make_port, service_name};
use crate::commit::{ChunkId, CommitReader};

/// Chunks that the learner holds at the same time.
const BORROWED: usize = 2;

/// Chunks that an actor fills at the same time.
const LOANED: usize = 2;

/// Processes that may have the service open.
const NODES: usize = 8;

/// The header of a chunk.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
pub struct ChunkHeader {
    /// Incarnation of the actor process that collected the rows.
    pub incarnation: u64,
    /// Number of the chunk, counted from 1 over all incarnations of this actor; 0 for a handshake.
    pub sequence: u64,
    /// Version of the policy that the last row was collected with.
    pub policy_version: u64,
    /// Rows in the chunk.
    pub rows: u32,
    /// The actor.
    pub actor: u32,
}

/// The actor's end.
#[derive(Debug)]
pub struct ChunkSender {
    service: ChunkService,
    publisher: Publisher<ipc::Service, [f32], ChunkHeader>,
    channel: String,
    layout: ChunkLayout,
    actor: u32,
    incarnation: u64,
    sent: u64,
}

/// The actor's end after it has sent its handshake. It may send rows once the handshake is committed.
#[derive(Debug)]
pub struct Handshake(ChunkSender);

/// The end of the process that forwards what an actor of another host has sent. The learner cannot tell it from the
/// actor: the chunks keep the actor's headers, and the history holds the actor's chunks.
#[derive(Debug)]
pub struct ChunkForwarder {
    publisher: Publisher<ipc::Service, [f32], ChunkHeader>,
    channel: String,
    layout: ChunkLayout,
}

/// A chunk being filled, in the shared memory that it is sent in.
#[derive(Debug)]
pub struct Chunk {
    sample: SampleMut<ipc::Service, [f32], ChunkHeader>,
    layout: ChunkLayout,
    filled: usize,
}

/// The learner's end.
#[derive(Debug)]
pub struct ChunkReceiver {
    subscriber: Subscriber<ipc::Service, [f32], ChunkHeader>,
    channel: String,
    layout: ChunkLayout,
}

/// A received chunk in the sender's memory. Dropping it frees the memory.
#[derive(Debug)]
pub struct ReceivedChunk {
    sample: Sample<ipc::Service, [f32], ChunkHeader>,
    layout: ChunkLayout,
}

impl Handshake {
    /// Waits until the handshake is committed, and calls `idle` at each pause.
    ///
    /// # Errors
    /// When `stop` is requested or the channel fails.
    pub fn wait(
        self,
        commits: &CommitReader,
        listener: &Listener,
        stop: &Stop,
        mut idle: impl FnMut(),
    ) -> Result<ChunkSender, Exit<ChannelError>> {
        let Self(mut sender) = self;
        let newest = wait_for(
            listener,
            stop,
            || {
                let newest = commits.committed(sender.actor as usize);
                Ok((newest.incarnation == sender.incarnation).then_some(newest))
            },
            || {
                idle();
                sender.refresh_connections()
            },
        )?;
        sender.sent = newest.sequence;
        Ok(sender)
    }
}

impl ChunkSender {
    /// Opens the sending end of `actor` and sends the handshake. The chunks have this layout, and at most `window` of
    /// them may be uncommitted. Incarnations count from 1.
    ///
    /// # Errors
    /// When shared memory is unavailable, or the previous process of this actor is still alive.
    pub fn open(
        domain: &Domain,
        actor: u32,
        incarnation: u64,
        layout: ChunkLayout,
        window: u32,
    ) -> Result<Handshake, ChannelError> {
        let channel = name(actor);
        let (service, publisher) = make_port(|| {
            let service = service(domain, &channel, window, OpenMode::Open)?;
            let publisher = publisher(&service, &channel, &layout)?;
            Ok((service, publisher))
        })?;
        let sender = Self {
            service,
            publisher,
            channel,
            layout,
            actor,
            incarnation,
            sent: 0,
        };
        sender.deliver(sender.empty_chunk()?, 0)?;
        Ok(Handshake(sender))
    }

    /// Sequence number of the last chunk sent; 0 before the first.
    pub fn sent(&self) -> u64 {
        self.sent
    }

    /// Chunks sent but not committed. `committed` is the id of this actor's last chunk in the replay.
    pub fn in_flight(&self, committed: ChunkId) -> u64 {
        self.sent.saturating_sub(committed.sequence)
    }

    /// An empty chunk.
    ///
    /// # Errors
    /// When shared memory is exhausted.
    pub fn empty_chunk(&self) -> Result<Chunk, ChannelError> {
        let sample = self
            .publisher
            .loan_slice(self.layout.len())
            .map_err(|cause| ChannelError::new(&self.channel, "begin a chunk", cause))?;
        Ok(Chunk {
            sample,
            layout: self.layout,
            filled: 0,
        })
    }

    /// Sends a chunk, full or not. `policy_version` is the version that its last row was collected with.
    ///
    /// # Errors
    /// When the connection to the learner fails.
    pub fn send(&mut self, chunk: Chunk, policy_version: u64) -> Result<(), ChannelError> {
        self.sent += 1;
        self.deliver(chunk, policy_version)
    }

    fn deliver(&self, mut chunk: Chunk, policy_version: u64) -> Result<(), ChannelError> {
        *chunk.sample.user_header_mut() = ChunkHeader {
            incarnation: self.incarnation,
            sequence: self.sent,
            policy_version,
            // Fits into 32 bits: the configuration bounds the rows of a chunk.
            rows: chunk.filled as u32,
            actor: self.actor,
        };
        let rows = chunk.filled;
        chunk
            .sample
            .send()
            .map_err(|cause| ChannelError::new(&self.channel, "send", cause))?;
        tracing::debug!(self.incarnation, self.sent, rows, "sent a chunk");
        Ok(())
    }

    /// Whether a learner is connected. A killed learner counts until the launcher has cleaned up after it.
    pub fn has_receiver(&self) -> bool {
        self.service.dynamic_config().number_of_subscribers() > 0
    }

    /// Connects to a new learner, which then receives the chunks in the history. Call this while waiting.
    ///
    /// # Errors
    /// When the connection fails.
    pub fn refresh_connections(&self) -> Result<(), ChannelError> {
        self.publisher
            .update_connections()
            .map_err(|cause| ChannelError::new(&self.channel, "reconnect", cause))
    }
}

impl ChunkForwarder {
    /// Opens the sending end of `actor`, whose chunks have this layout. At most `window` of them may be uncommitted.
    /// `None` if another process sends for this actor at the moment: try again later.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn try_open(
        domain: &Domain,
        actor: u32,
        layout: ChunkLayout,
        window: u32,
    ) -> Result<Option<Self>, ChannelError> {
        Self::try_open_channel(domain, name(actor), layout, window)
    }

    /// As [`try_open`](Self::try_open), for the service that `actors` actors share.
    ///
    /// # Errors
    /// As [`try_open`](Self::try_open).
    pub fn try_open_shared(
        domain: &Domain,
        actors: u32,
        layout: ChunkLayout,
        window: u32,
    ) -> Result<Option<Self>, ChannelError> {
        Self::try_open_channel(domain, SHARED.into(), layout, actors * window)
    }

    fn try_open_channel(
        domain: &Domain,
        channel: String,
        layout: ChunkLayout,
        window: u32,
    ) -> Result<Option<Self>, ChannelError> {
        let opened = service(domain, &channel, window, OpenMode::Open);
        match opened.and_then(|service| publisher(&service, &channel, &layout)) {
            Ok(publisher) => Ok(Some(Self {
                publisher,
                channel,
                layout,
            })),
            Err(error) if error.is_transient() => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The rows of a chunk with this header, and after them the numbers of the actor's snapshot. `None` if `numbers`
    /// are not those of such a chunk: a handshake has neither rows nor a snapshot.
    pub fn parts<'a>(&self, header: &ChunkHeader, numbers: &'a [f32]) -> Option<(&'a [f32], &'a [f32])> {
        let rows = header.rows as usize;
        let snapshot = self.layout.len() - self.layout.rows_len();
        let (most_rows, snapshot) = match header.sequence {
            0 => (0, 0),
            _ => (self.layout.rows, snapshot),
        };
        let split = numbers.split_at_checked(rows.checked_mul(self.layout.row.width())?)?;
        (rows <= most_rows && split.1.len() == snapshot).then_some(split)
    }

    /// Sends a chunk with this header, of which `numbers` are the [`parts`](Self::parts).
    ///
    /// # Errors
    /// When they are not, or the connection to the learner fails.
    pub fn send(&self, header: ChunkHeader, numbers: &[f32]) -> Result<(), ChannelError> {
        let Some((rows, snapshot)) = self.parts(&header, numbers) else {
            let cause = PeerError::ChunkLength {
                numbers: numbers.len(),
                rows: header.rows as usize,
            };
            return Err(ChannelError::new(&self.channel, "send", cause));
        };
        let failed = |cause| ChannelError::new(&self.channel, "send", cause);
        let mut sample = self
            .publisher
            .loan_slice(self.layout.len())
            .map_err(|cause| ChannelError::new(&self.channel, "begin a chunk", cause))?;
        *sample.user_header_mut() = header;
        sample.payload_mut()[..rows.len()].copy_from_slice(rows);
        let end = self.layout.rows_len();
        sample.payload_mut()[end..][..snapshot.len()].copy_from_slice(snapshot);
        sample.send().map(drop).map_err(failed)
    }

    /// Connects to a new learner, which then receives the chunks in the history. Call this while waiting.
    ///
    /// # Errors
    /// When the connection fails.
    pub fn refresh_connections(&self) -> Result<(), ChannelError> {
        self.publisher
            .update_connections()
            .map_err(|cause| ChannelError::new(&self.channel, "reconnect", cause))
    }
}

impl Chunk {
    /// Writes the next row. A full chunk ignores it.
    pub fn push(&mut self, transition: &Transition<'_>) {
        let rows = self.layout.rows_len();
        let mut rows = self.sample.payload_mut()[..rows].chunks_exact_mut(self.layout.row.width());
        if let Some(row) = rows.nth(self.filled) {
            self.layout.row.write(transition, row);
            self.filled += 1;
        }
    }

    /// Sets the actor's snapshot after the last row.
    ///
    /// # Panics
    /// If there are not exactly as many words as the layout requires.
    pub fn set_actor_snapshot(&mut self, words: &[u64]) {
        let rows = self.layout.rows_len();
        self.sample.payload_mut()[rows..].copy_from_slice(numbers_of(words));
    }

    /// Discards the rows.
    pub fn clear(&mut self) {
        self.filled = 0;
    }

    /// Rows written.
    pub fn len(&self) -> usize {
        self.filled
    }

    /// Whether no row is written.
    pub fn is_empty(&self) -> bool {
        self.filled == 0
    }

    /// Whether every row is written.
    pub fn is_full(&self) -> bool {
        self.filled == self.layout.rows
    }
}

impl ChunkReceiver {
    /// Opens the receiving end of `actor`'s chunks, which have this layout.
    ///
    /// # Errors
    /// When shared memory is unavailable, or another learner is still alive.
    pub fn open(domain: &Domain, actor: u32, layout: ChunkLayout, window: u32) -> Result<Self, ChannelError> {
        Self::open_channel(domain, name(actor), layout, window)
    }

    /// As [`open`](Self::open), for the service that `actors` actors share.
    ///
    /// # Errors
    /// As [`open`](Self::open).
    pub fn open_shared(domain: &Domain, actors: u32, layout: ChunkLayout, window: u32) -> Result<Self, ChannelError> {
        Self::open_channel(domain, SHARED.into(), layout, actors * window)
    }

    fn open_channel(domain: &Domain, channel: String, layout: ChunkLayout, window: u32) -> Result<Self, ChannelError> {
        let subscriber = make_port(|| {
            service(domain, &channel, window, OpenMode::Open)?
                .subscriber_builder()
                .buffer_size(buffer(window))
                .create()
                .map_err(|cause| ChannelError::new(&channel, "receive", cause))
        })?;
        Ok(Self {
            subscriber,
            channel,
            layout,
        })
    }

    /// The next chunk, if there is one.
    ///
    /// # Errors
    /// When the sender's memory cannot be mapped, or the chunk does not have this layout.
    pub fn receive(&self) -> Result<Option<ReceivedChunk>, ChannelError> {
        let received = self
            .subscriber
            .receive()
            .map_err(|cause| ChannelError::new(&self.channel, "receive", cause))?;
        let Some(sample) = received else { return Ok(None) };
        let (rows, numbers) = (sample.user_header().rows as usize, sample.payload().len());
        if rows > self.layout.rows || numbers != self.layout.len() {
            let cause = PeerError::ChunkLength { numbers, rows };
            return Err(ChannelError::new(&self.channel, "receive", cause));
        }
        Ok(Some(ReceivedChunk {
            sample,
            layout: self.layout,
        }))
    }
}

impl ReceivedChunk {
    /// The chunk's header.
    pub fn header(&self) -> &ChunkHeader {
        self.sample.user_header()
    }

    /// The chunk's id. `committed` is the id of the last committed chunk of its actor: a handshake keeps its sequence
    /// number, and only announces the new incarnation.
    pub fn id(&self, committed: ChunkId) -> ChunkId {
        let ChunkHeader {
            incarnation, sequence, ..
        } = *self.header();
        ChunkId {
            incarnation,
            sequence: if self.is_handshake() {
                committed.sequence
            } else {
                sequence
            },
        }
    }

    fn is_handshake(&self) -> bool {
        self.header().sequence == 0
    }

    /// Its rows, one after the other.
    pub fn rows(&self) -> &[f32] {
        &self.sample.payload()[..self.header().rows as usize * self.layout.row.width()]
    }

    /// Its rows, and the numbers of the actor's snapshot after them; no numbers for a handshake, and if the layout has
    /// no snapshots.
    pub fn parts(&self) -> (&[f32], &[f32]) {
        let snapshot = &self.sample.payload()[self.layout.rows_len()..];
        (self.rows(), if self.is_handshake() { &[] } else { snapshot })
    }

    /// The actor's snapshot after it; `None` for a handshake, and if the layout has no snapshots.
    pub fn actor_snapshot(&self) -> Option<Vec<u64>> {
        let rows = self.layout.rows_len();
        let present = self.layout.actor_snapshot_words > 0 && !self.is_handshake();
        present.then(|| words_of(&self.sample.payload()[rows..]))
    }
}

/// Bytes of shared memory that one actor's chunks of this layout reserve with this window; for a shared service, the
/// window is the sum of all actors'.
pub fn reserved(layout: &ChunkLayout, window: u32) -> u64 {
    let chunks = buffer(window) + BORROWED + window as usize + LOANED;
    memory::service(NODES)
        + memory::segment::<Header, ChunkHeader>(chunks, size_of::<f32>() * layout.len())
        + memory::connection(1, buffer(window), BORROWED, chunks)
}

/// The name of the service that actors share.
const SHARED: &str = "transitions/shared";

fn name(actor: u32) -> String {
    format!("transitions/{actor}")
}

fn buffer(window: u32) -> usize {
    2 * window as usize
}

/// Creates the service for the chunks of `actor`, of which at most `window` may be uncommitted.
pub(super) fn create(domain: &Domain, actor: u32, window: u32) -> Result<HeldService, ChannelError> {
    create_channel(domain, &name(actor), window)
}

/// Creates the service that `actors` actors share. Each may have `window` uncommitted chunks.
pub(super) fn create_shared(domain: &Domain, actors: u32, window: u32) -> Result<HeldService, ChannelError> {
    create_channel(domain, SHARED, actors * window)
}

fn create_channel(domain: &Domain, channel: &str, window: u32) -> Result<HeldService, ChannelError> {
    service(domain, channel, window, OpenMode::Create).map(HeldService::of_publish_subscribe)
}

fn publisher(
    service: &ChunkService,
    channel: &str,
    layout: &ChunkLayout,
) -> Result<Publisher<ipc::Service, [f32], ChunkHeader>, ChannelError> {
    service
        .publisher_builder()
        .initial_max_slice_len(layout.len())
        .max_loaned_samples(LOANED)
        .create()
        .map_err(|cause| ChannelError::new(channel, "send", cause))
}

type ChunkService = PortFactory<ipc::Service, [f32], ChunkHeader>;

fn service(domain: &Domain, channel: &str, window: u32, mode: OpenMode) -> Result<ChunkService, ChannelError> {
    let builder = domain
        .node()
        .service_builder(&service_name(domain, channel)?)
        .publish_subscribe::<[f32]>()
        .user_header::<ChunkHeader>()
        .max_publishers(1)
        .max_subscribers(1)
        .max_nodes(NODES)
        .enable_safe_overflow(false)
        .history_size(window as usize)
        .subscriber_max_buffer_size(buffer(window))
        .subscriber_max_borrowed_samples(BORROWED);
    mode.service(channel, builder, |b| b.create(), |b| b.open())
}
