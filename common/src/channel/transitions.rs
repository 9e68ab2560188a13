//! Transitions, from one actor to the learner, in chunks of rows.
//!
//! An actor keeps at most `window` chunks sent but not committed, the service's history holds as many, and the learner's
//! buffer twice as many (a new learner may find a whole history that it has committed already, and a whole window on top).
//! So `send` always finds room, and what a dead learner had not committed reaches the next one.
//!
//! What a dead actor had sent still arrives, and before anything of its next start, if the learner was connected to it.
//! Nobody can ask for that, so an actor first sends an empty chunk, and no row before that one is committed.

use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::header::publish_subscribe::Header;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use super::{ChannelError, Domain, claim, memory, service_name};
use crate::commit::ChunkMark;
use crate::transition::{RowLayout, Transition};

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
    /// Counts the actor's chunks, from 1.
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
    publisher: Publisher<ipc::Service, [f32], ChunkHeader>,
    channel: String,
    layout: RowLayout,
    rows: usize,
    actor: u32,
    incarnation: u64,
    window: u64,
    sent: u64,
}

/// A chunk being filled, in the memory it will be sent in.
#[derive(Debug)]
pub struct Chunk {
    sample: SampleMut<ipc::Service, [f32], ChunkHeader>,
    layout: RowLayout,
    rows: usize,
    filled: usize,
}

/// The learner's end.
#[derive(Debug)]
pub struct ChunkReceiver {
    subscriber: Subscriber<ipc::Service, [f32], ChunkHeader>,
    channel: String,
}

/// A chunk in the sender's memory; its place is free again when this is dropped.
#[derive(Debug)]
pub struct ReceivedChunk {
    sample: Sample<ipc::Service, [f32], ChunkHeader>,
    width: usize,
}

impl ChunkSender {
    /// The sending end of `actor`, whose chunks have `rows` rows and of which `window` may be uncommitted. The sequence
    /// goes on after `sent`. Incarnations count from 1.
    ///
    /// # Errors
    /// When shared memory cannot be had, or the actor before this one still lives.
    pub fn open(
        domain: &Domain,
        actor: u32,
        incarnation: u64,
        sent: u64,
        layout: RowLayout,
        rows: usize,
        window: u32,
    ) -> Result<Self, ChannelError> {
        let channel = name(actor);
        let publisher = claim(domain, &channel, "send", || {
            service(domain, &channel, window)?
                .publisher_builder()
                .initial_max_slice_len(rows * layout.width())
                .max_loaned_samples(LOANED)
                .create()
                .map_err(|cause| ChannelError::new(&channel, "send", cause))
        })?;
        let sender = Self {
            publisher,
            channel,
            layout,
            rows,
            actor,
            incarnation,
            window: window.into(),
            sent,
        };
        sender.deliver(sender.begin()?, 0)?;
        Ok(sender)
    }

    /// Sequence number of the chunk sent last; 0 before the first.
    pub fn sent(&self) -> u64 {
        self.sent
    }

    /// Chunks sent that `committed`, the newest mark of this actor in the replay, does not cover; a whole window until the
    /// learner has taken the empty chunk.
    pub fn in_flight(&self, committed: ChunkMark) -> u64 {
        if committed.incarnation == self.incarnation {
            self.sent.saturating_sub(committed.sequence)
        } else {
            self.window
        }
    }

    /// An empty chunk.
    ///
    /// # Errors
    /// When shared memory is exhausted.
    pub fn begin(&self) -> Result<Chunk, ChannelError> {
        let sample = self
            .publisher
            .loan_slice(self.rows * self.layout.width())
            .map_err(|cause| ChannelError::new(&self.channel, "begin a chunk", cause))?;
        Ok(Chunk {
            sample,
            layout: self.layout,
            rows: self.rows,
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
        chunk
            .sample
            .send()
            .map(|_| ())
            .map_err(|cause| ChannelError::new(&self.channel, "send", cause))
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
        let width = self.layout.width();
        if let Some(row) = self.sample.payload_mut().chunks_exact_mut(width).nth(self.filled) {
            self.layout.write(transition, row);
            self.filled += 1;
        }
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
        self.filled == self.rows
    }
}

impl ChunkReceiver {
    /// The receiving end of `actor`'s chunks.
    ///
    /// # Errors
    /// When shared memory cannot be had, or another learner lives.
    pub fn open(domain: &Domain, actor: u32, window: u32) -> Result<Self, ChannelError> {
        let channel = name(actor);
        let subscriber = claim(domain, &channel, "receive", || {
            service(domain, &channel, window)?
                .subscriber_builder()
                .buffer_size(buffer(window))
                .create()
                .map_err(|cause| ChannelError::new(&channel, "receive", cause))
        })?;
        Ok(Self { subscriber, channel })
    }

    /// The next chunk, if there is one.
    ///
    /// # Errors
    /// When the sender's memory cannot be mapped, or the chunk contradicts itself.
    pub fn receive(&self, layout: RowLayout) -> Result<Option<ReceivedChunk>, ChannelError> {
        let received = self
            .subscriber
            .receive()
            .map_err(|cause| ChannelError::new(&self.channel, "receive", cause))?;
        let Some(sample) = received else { return Ok(None) };
        let width = layout.width();
        if sample.user_header().rows as usize * width > sample.payload().len() {
            let cause = format!(
                "a chunk of {} numbers claims {} rows",
                sample.payload().len(),
                sample.user_header().rows
            );
            return Err(ChannelError {
                channel: self.channel.clone(),
                action: "receive",
                cause,
            });
        }
        Ok(Some(ReceivedChunk { sample, width }))
    }
}

impl ReceivedChunk {
    /// What is known of the chunk.
    pub fn header(&self) -> &ChunkHeader {
        self.sample.user_header()
    }

    /// Where the chunk stands in its actor's sequence.
    pub fn mark(&self) -> ChunkMark {
        ChunkMark {
            incarnation: self.header().incarnation,
            sequence: self.header().sequence,
        }
    }

    /// Its filled rows, one after the other.
    pub fn rows(&self) -> &[f32] {
        &self.sample.payload()[..self.header().rows as usize * self.width]
    }
}

/// Bytes of shared memory that one actor's chunks reserve, with so many rows each and such a window.
pub fn reserved(layout: RowLayout, rows: usize, window: u32) -> u64 {
    let chunks = buffer(window) + BORROWED + window as usize + LOANED;
    memory::service(NODES)
        + memory::segment::<Header, ChunkHeader>(chunks, size_of::<f32>() * rows * layout.width())
        + memory::connection(1, buffer(window), BORROWED, chunks)
}

fn name(actor: u32) -> String {
    format!("transitions/{actor}")
}

fn buffer(window: u32) -> usize {
    2 * window as usize
}

type ChunkService = PortFactory<ipc::Service, [f32], ChunkHeader>;

fn service(domain: &Domain, channel: &str, window: u32) -> Result<ChunkService, ChannelError> {
    domain
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
        .subscriber_max_borrowed_samples(BORROWED)
        .open_or_create()
        .map_err(|cause| ChannelError::new(channel, "open", cause))
}
