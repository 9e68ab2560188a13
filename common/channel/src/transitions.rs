//! Transitions, from one actor to the learner, in chunks of rows.
//!
//! An actor keeps at most `window` chunks sent but not committed, the service's history holds as many, and the learner's
//! buffer twice as many (a new learner may find a whole history that it has committed already, and a whole window on top).
//! So `send` always finds room, and what a dead learner had not committed reaches the next one.
//!
//! What a dead actor had sent still arrives, and before anything of its next start, if the learner was connected to it.
//! Nobody can ask for that, so an actor first sends an empty chunk, its [`Handshake`], and no row before that one is
//! committed. By then it is certain what of its predecessor is in the replay, and its sequence goes on after that.

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
use super::service::{Entry, Held, claim, service_name};
use crate::commit::{ChunkMark, CommitReader};

/// Chunks the learner has in hand.
const BORROWED: usize = 2;

/// Chunks an actor has in hand.
const LOANED: usize = 2;

/// Processes that may take part in one flow.
const NODES: usize = 8;

/// What a chunk's receiver knows of it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
pub struct ChunkHeader {
    /// The actor's start that collected the rows.
    pub incarnation: u64,
    /// Counts the chunks of this actor, from 1 and over all its starts; 0 for a handshake.
    pub sequence: u64,
    /// Version of the policy that the last row was collected with.
    pub policy_version: u64,
    /// Rows that are filled.
    pub rows: u32,
    /// The actor.
    pub actor: u32,
}

/// An actor's end.
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

/// An actor's end that has said that it is there, and may send no row before that is committed.
#[derive(Debug)]
pub struct Handshake(ChunkSender);

/// A chunk being filled, in the memory it will be sent in.
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

/// A chunk in the sender's memory; its place is free again when this is dropped.
#[derive(Debug)]
pub struct ReceivedChunk {
    sample: Sample<ipc::Service, [f32], ChunkHeader>,
    layout: ChunkLayout,
}

impl Handshake {
    /// Waits until the handshake is committed; `idle` is called at each pause.
    ///
    /// # Errors
    /// When interrupted.
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
                sender.look_after()
            },
        )?;
        sender.sent = newest.sequence;
        Ok(sender)
    }
}

impl ChunkSender {
    /// The sending end of `actor`, whose chunks have this layout and of which `window` may be uncommitted. Incarnations
    /// count from 1.
    ///
    /// # Errors
    /// When shared memory cannot be had, or the actor before this one still lives.
    pub fn open(
        domain: &Domain,
        actor: u32,
        incarnation: u64,
        layout: ChunkLayout,
        window: u32,
    ) -> Result<Handshake, ChannelError> {
        let channel = name(actor);
        let (service, publisher) = claim(|| {
            let service = service(domain, &channel, window, Entry::Open)?;
            let publisher = service
                .publisher_builder()
                .initial_max_slice_len(layout.len())
                .max_loaned_samples(LOANED)
                .create()
                .map_err(|cause| ChannelError::new(&channel, "send", cause))?;
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
        sender.deliver(sender.begin()?, 0)?;
        Ok(Handshake(sender))
    }

    /// Sequence number of the chunk sent last; 0 before the first.
    pub fn sent(&self) -> u64 {
        self.sent
    }

    /// Chunks sent that `committed`, the newest mark of this actor in the replay, does not cover.
    pub fn in_flight(&self, committed: ChunkMark) -> u64 {
        self.sent.saturating_sub(committed.sequence)
    }

    /// An empty chunk.
    ///
    /// # Errors
    /// When shared memory is exhausted.
    pub fn begin(&self) -> Result<Chunk, ChannelError> {
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

    /// Sends a chunk, full or not, whose rows were collected with the policy up to `policy_version`.
    ///
    /// # Errors
    /// When the connection to the learner cannot be made.
    pub fn send(&mut self, chunk: Chunk, policy_version: u64) -> Result<(), ChannelError> {
        self.sent += 1;
        self.deliver(chunk, policy_version)
    }

    fn deliver(&self, mut chunk: Chunk, policy_version: u64) -> Result<(), ChannelError> {
        *chunk.sample.user_header_mut() = ChunkHeader {
            incarnation: self.incarnation,
            sequence: self.sent,
            policy_version,
            // A chunk's rows fit: the configuration bounds them.
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

    /// Whether there is a learner to take chunks; one that was killed counts until the launcher has cleaned up after it.
    pub fn is_heard(&self) -> bool {
        self.service.dynamic_config().number_of_subscribers() > 0
    }

    /// Hands what is not committed to a learner that has come anew. To be called while waiting.
    ///
    /// # Errors
    /// When the connection cannot be made.
    pub fn look_after(&self) -> Result<(), ChannelError> {
        self.publisher
            .update_connections()
            .map_err(|cause| ChannelError::new(&self.channel, "reconnect", cause))
    }
}

impl Chunk {
    /// Writes the next row. A full chunk takes no more.
    pub fn push(&mut self, transition: &Transition<'_>) {
        let rows = self.layout.numbers_of_rows();
        let mut rows = self.sample.payload_mut()[..rows].chunks_exact_mut(self.layout.row.width());
        if let Some(row) = rows.nth(self.filled) {
            self.layout.row.write(transition, row);
            self.filled += 1;
        }
    }

    /// Says where the actor stands after the last row.
    ///
    /// # Panics
    /// As `copy_from_slice` does: the layout says how many words there are.
    pub fn set_standing(&mut self, words: &[u64]) {
        let rows = self.layout.numbers_of_rows();
        self.sample.payload_mut()[rows..].copy_from_slice(numbers_of(words));
    }

    /// Takes the rows back, so that it is filled anew.
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
    /// The receiving end of `actor`'s chunks, which have this layout.
    ///
    /// # Errors
    /// When shared memory cannot be had, or another learner lives.
    pub fn open(domain: &Domain, actor: u32, layout: ChunkLayout, window: u32) -> Result<Self, ChannelError> {
        let channel = name(actor);
        let subscriber = claim(|| {
            service(domain, &channel, window, Entry::Open)?
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
    /// When the sender's memory cannot be mapped, or the chunk contradicts itself.
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
    /// What is known of the chunk.
    pub fn header(&self) -> &ChunkHeader {
        self.sample.user_header()
    }

    /// Where the chunk stands in its actor's sequence, of which `committed` is the newest. A handshake takes no place of its
    /// own: it says who goes on after it.
    pub fn mark(&self, committed: ChunkMark) -> ChunkMark {
        let ChunkHeader {
            incarnation, sequence, ..
        } = *self.header();
        ChunkMark {
            incarnation,
            sequence: if self.is_greeting() {
                committed.sequence
            } else {
                sequence
            },
        }
    }

    fn is_greeting(&self) -> bool {
        self.header().sequence == 0
    }

    /// Its filled rows, one after the other.
    pub fn rows(&self) -> &[f32] {
        &self.sample.payload()[..self.header().rows as usize * self.layout.row.width()]
    }

    /// Where the actor stands after it; `None` for a handshake, and where nobody asks.
    pub fn standing(&self) -> Option<Vec<u64>> {
        let rows = self.layout.numbers_of_rows();
        let asked = self.layout.actor_snapshot_words > 0 && !self.is_greeting();
        asked.then(|| words_of(&self.sample.payload()[rows..]))
    }
}

/// Bytes of shared memory that one actor's chunks of this layout reserve, with such a window.
pub fn reserved(layout: &ChunkLayout, window: u32) -> u64 {
    let chunks = buffer(window) + BORROWED + window as usize + LOANED;
    memory::service(NODES)
        + memory::segment::<Header, ChunkHeader>(chunks, size_of::<f32>() * layout.len())
        + memory::connection(1, buffer(window), BORROWED, chunks)
}

fn name(actor: u32) -> String {
    format!("transitions/{actor}")
}

fn buffer(window: u32) -> usize {
    2 * window as usize
}

/// Makes the service for the chunks of `actor`, of which `window` may be uncommitted.
pub(super) fn create(domain: &Domain, actor: u32, window: u32) -> Result<Held, ChannelError> {
    let service = service(domain, &name(actor), window, Entry::Create)?;
    Ok(Held::new(move |see| {
        let ports = service.dynamic_config();
        ports.list_publishers(|port| see(port.node_id, port.publisher_id.value()));
        ports.list_subscribers(|port| see(port.node_id, port.subscriber_id.value()));
    }))
}

type ChunkService = PortFactory<ipc::Service, [f32], ChunkHeader>;

fn service(domain: &Domain, channel: &str, window: u32, entry: Entry) -> Result<ChunkService, ChannelError> {
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
    entry.service(channel, builder, |b| b.create(), |b| b.open())
}
