//! Receives the actors' chunks and appends them to the replay, each exactly once.

use std::collections::BTreeSet;

use shoal_common::channel::transitions::{ChunkReceiver, ReceivedChunk};
use shoal_common::channel::{ChannelError, Domain, EventName, Notifier};
use shoal_common::numbers::are_finite;
use shoal_common::role::Role;
use shoal_common::transition::ChunkLayout;

use crate::replay::{Appended, ChunkError, Replay};

/// Why a chunk was not appended.
#[derive(Debug, thiserror::Error)]
pub enum IntakeError {
    /// The channel failed.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The chunk does not belong to this run.
    #[error("actor {actor} sent a chunk that does not belong to this run: {cause}")]
    Chunk {
        /// The actor that sent it.
        actor: usize,
        /// What is wrong with it.
        cause: ChunkError,
    },
    /// A row holds a number that no environment or policy may give.
    #[error("actor {actor} sent a row that cannot be learned from: its number {number} is {value}")]
    NotFinite {
        /// Who sent it.
        actor: usize,
        /// Which number of the row: of s, a, r, discount, s' and last, one after the other.
        number: usize,
        /// The number.
        value: f32,
    },
}

/// The receivers of all actors' chunks.
#[derive(Debug)]
pub struct Intake {
    actors: Vec<ActorChunks>,
    /// Of the actors that share a service. They need no notification: the gate reads the commit record.
    shared: Option<ChunkReceiver>,
    /// The actors that have sent through the shared service. The service gets a turn for each of them.
    sharing: BTreeSet<u32>,
    chunk: ChunkLayout,
    window: u32,
    /// The number of rows beyond which none are taken.
    limit: u64,
    /// The actor whose turn it is. Kept between calls: a learner that takes one chunk at a time must not take all of
    /// them from the first actor.
    turn: usize,
}

#[derive(Debug)]
struct ActorChunks {
    receiver: ChunkReceiver,
    notifier: Notifier,
}

impl Intake {
    /// Opens the receivers for actors `0 .. actors`. No rows are taken beyond `limit`.
    ///
    /// # Errors
    /// When shared memory is unavailable, or another learner is alive.
    pub fn open(
        domain: &Domain,
        actors: u32,
        window: u32,
        chunk: ChunkLayout,
        limit: u64,
    ) -> Result<Self, ChannelError> {
        let mut intake = Self {
            actors: Vec::new(),
            shared: None,
            sharing: BTreeSet::new(),
            chunk,
            window,
            limit,
            turn: 0,
        };
        intake.open_receivers(domain, actors)?;
        Ok(intake)
    }

    /// Opens the receivers for actors `0 .. actors` that are not open yet. None is ever closed: that of a retired actor
    /// costs little, and the actor may come back.
    ///
    /// # Errors
    /// As `open`.
    pub fn open_receivers(&mut self, domain: &Domain, actors: u32) -> Result<(), ChannelError> {
        for actor in self.actors.len() as u32..actors {
            self.actors.push(ActorChunks {
                receiver: ChunkReceiver::open(domain, actor, self.chunk, self.window)?,
                notifier: Notifier::new(domain, EventName(Role::Actor, actor))?,
            });
        }
        Ok(())
    }

    /// Opens the receiver of the service that `actors` actors share.
    ///
    /// # Errors
    /// As `open`.
    pub fn open_shared_receiver(&mut self, domain: &Domain, actors: u32) -> Result<(), ChannelError> {
        self.shared = Some(ChunkReceiver::open_shared(domain, actors, self.chunk, self.window)?);
        Ok(())
    }

    /// The number of actors with an open receiver of their own.
    pub fn actor_count(&self) -> usize {
        self.actors.len()
    }

    /// Takes one chunk of each actor in turn, until none is waiting, `most` of each were taken, or `enough` returns
    /// true. Chunks of actors that share a service are taken in the order in which they come. Returns whether any chunk
    /// was taken.
    ///
    /// # Errors
    /// When a channel fails, or a chunk does not belong to this run.
    pub fn take_in_turn(
        &mut self,
        replay: &mut Replay,
        most: u32,
        enough: impl Fn(&Replay) -> bool,
    ) -> Result<bool, IntakeError> {
        let shared_turns = usize::from(self.shared.is_some()).max(self.sharing.len());
        let turns = self.actors.len() + shared_turns;
        let (mut any, mut idle) = (false, 0);
        for _ in 0..u64::from(most) * turns as u64 {
            if idle >= turns || enough(replay) || replay.head() >= self.limit {
                break;
            }
            let has_own_service = self.turn < self.actors.len();
            let taken = if has_own_service {
                self.take_from(self.turn, replay)?
            } else {
                self.take_shared(replay)?
            };
            // An empty shared service gives up its remaining turns.
            let passed = match taken {
                None if !has_own_service => turns - self.turn,
                _ => 1,
            };
            if taken.is_some() {
                (any, idle) = (true, 0);
            } else {
                idle += passed;
            }
            self.turn = (self.turn + passed) % turns;
        }
        Ok(any)
    }

    /// Takes the next chunk of one actor. A chunk that is committed already is dropped.
    ///
    /// # Errors
    /// When the channel fails, or the chunk does not belong to this run.
    pub fn take_from(&self, actor: usize, replay: &mut Replay) -> Result<Option<Appended>, IntakeError> {
        let source = &self.actors[actor];
        let Some(chunk) = source.receiver.receive()? else {
            return Ok(None);
        };
        let appended = self.append(replay, actor, &chunk)?;
        drop(chunk);
        source.notifier.notify();
        Ok(Some(appended))
    }

    fn take_shared(&mut self, replay: &mut Replay) -> Result<Option<Appended>, IntakeError> {
        let Some(chunk) = self.shared.as_ref().map(ChunkReceiver::receive).transpose()?.flatten() else {
            return Ok(None);
        };
        let actor = chunk.header().actor;
        let appended = self.append(replay, actor as usize, &chunk)?;
        self.sharing.insert(actor);
        Ok(Some(appended))
    }

    /// Appends the rows of a chunk, as many as the limit allows.
    fn append(&self, replay: &mut Replay, actor: usize, chunk: &ReceivedChunk) -> Result<Appended, IntakeError> {
        let rows = self.limit.saturating_sub(replay.head()).min(chunk.header().rows.into());
        append(replay, actor, chunk, rows as usize * self.chunk.row.width())
    }

    /// Notifies every actor that there is a new policy.
    pub fn notify_all(&self) {
        self.actors.iter().for_each(|source| source.notifier.notify());
    }
}

fn append(replay: &mut Replay, actor: usize, chunk: &ReceivedChunk, numbers: usize) -> Result<Appended, IntakeError> {
    let rows = &chunk.rows()[..numbers];
    if !are_finite(rows) {
        let width = replay.layout().row.width();
        let bad = rows.iter().position(|number| !number.is_finite()).unwrap_or_default();
        return Err(IntakeError::NotFinite {
            actor,
            number: bad % width,
            value: rows[bad],
        });
    }
    let id = chunk.id(replay.committed(actor).last_chunk);
    let refused = |cause| IntakeError::Chunk { actor, cause };
    let Some(reserved) = replay.begin(actor, id).map_err(refused)? else {
        return Ok(Appended::Duplicate);
    };
    let filled = reserved.fill(rows).map_err(refused)?;
    match chunk.actor_snapshot() {
        Some(words) => filled.with_snapshot(&words).commit(),
        None => filled.commit(),
    }
    Ok(Appended::Accepted)
}
