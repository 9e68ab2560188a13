//! Takes the actors' chunks into the replay, each exactly once.

use shoal_common::channel::transitions::{ChunkReceiver, ReceivedChunk};
use shoal_common::channel::{ChannelError, Domain, EventName, Notifier};
use shoal_common::report::Role;
use shoal_common::transition::ChunkLayout;

use crate::replay::{Appended, ChunkError, Replay, are_finite};

/// Why a chunk was not taken in.
#[derive(Debug, thiserror::Error)]
pub enum IntakeError {
    /// The channel does not work.
    #[error(transparent)]
    Channel(#[from] ChannelError),
    /// The chunk is none of this run.
    #[error("actor {actor} sent a chunk that is none of this run: {cause}")]
    Chunk {
        /// Who sent it.
        actor: usize,
        /// What is wrong with it.
        cause: ChunkError,
    },
    /// A row holds a number that no environment or policy may give.
    #[error("actor {actor} sent a row that is not learned from: its number {number} is {value}")]
    NotFinite {
        /// Who sent it.
        actor: usize,
        /// Which number of the row: of s, a, r, discount, s' and last, one after the other.
        number: usize,
        /// The number.
        value: f32,
    },
}

/// The receiving ends of all actors.
#[derive(Debug)]
pub struct Intake {
    sources: Vec<Source>,
    chunk: ChunkLayout,
    window: u32,
    /// Rows after which nothing more is taken.
    limit: u64,
    /// Whose turn it is. Kept from one call to the next: a learner that takes one chunk at a time must not take all of
    /// them from the first actor.
    turn: usize,
}

#[derive(Debug)]
struct Source {
    receiver: ChunkReceiver,
    listener: Notifier,
}

impl Intake {
    /// Opens the receiving ends of actors `0 .. actors`; nothing is taken beyond `limit` rows.
    ///
    /// # Errors
    /// When shared memory cannot be had, or another learner lives.
    pub fn open(
        domain: &Domain,
        actors: u32,
        window: u32,
        chunk: ChunkLayout,
        limit: u64,
    ) -> Result<Self, ChannelError> {
        let mut intake = Self {
            sources: Vec::new(),
            chunk,
            window,
            limit,
            turn: 0,
        };
        intake.widen(domain, actors)?;
        Ok(intake)
    }

    /// Opens the receiving ends of actors `0 .. actors` where they are not open yet. None is ever closed: an actor that
    /// has retired costs a look, and may come back.
    ///
    /// # Errors
    /// As `open`.
    pub fn widen(&mut self, domain: &Domain, actors: u32) -> Result<(), ChannelError> {
        for actor in self.sources.len() as u32..actors {
            self.sources.push(Source {
                receiver: ChunkReceiver::open(domain, actor, self.chunk, self.window)?,
                listener: Notifier::new(domain, EventName(Role::Actor, actor))?,
            });
        }
        Ok(())
    }

    /// How many actors there are.
    pub fn actors(&self) -> usize {
        self.sources.len()
    }

    /// Takes chunks in turn, one of each actor at a time, until none is waiting, there were `most` of each, or `enough`
    /// says so of the replay. Returns whether there was any.
    ///
    /// # Errors
    /// When a channel does not work or a chunk is none of this run.
    pub fn drain(
        &mut self,
        replay: &mut Replay,
        most: u32,
        enough: impl Fn(&Replay) -> bool,
    ) -> Result<bool, IntakeError> {
        let actors = self.sources.len();
        let (mut any, mut idle) = (false, 0);
        for _ in 0..u64::from(most) * actors as u64 {
            if idle == actors || enough(replay) || replay.head() >= self.limit {
                break;
            }
            if self.take_from(self.turn, replay)?.is_some() {
                (any, idle) = (true, 0);
            } else {
                idle += 1;
            }
            self.turn = (self.turn + 1) % actors;
        }
        Ok(any)
    }

    /// Takes the next chunk of one actor, whether it is new or was committed before.
    ///
    /// # Errors
    /// When the channel does not work or the chunk is none of this run.
    pub fn take_from(&self, actor: usize, replay: &mut Replay) -> Result<Option<Appended>, IntakeError> {
        let source = &self.sources[actor];
        let Some(chunk) = source.receiver.receive()? else {
            return Ok(None);
        };
        let room = (self.limit - replay.head()).min(chunk.header().rows.into()) as usize * self.chunk.row.width();
        let appended = append(replay, actor, &chunk, room)?;
        drop(chunk);
        source.listener.notify();
        Ok(Some(appended))
    }

    /// Rings every actor's bell: there is a policy to go on with.
    pub fn ring_all(&self) {
        self.sources.iter().for_each(|source| source.listener.notify());
    }
}

fn append(replay: &mut Replay, actor: usize, chunk: &ReceivedChunk, room: usize) -> Result<Appended, IntakeError> {
    let rows = &chunk.rows()[..room];
    if !are_finite(rows) {
        let width = replay.layout().row.width();
        let bad = rows.iter().position(|number| !number.is_finite()).unwrap_or_default();
        return Err(IntakeError::NotFinite {
            actor,
            number: bad % width,
            value: rows[bad],
        });
    }
    let mark = chunk.mark(replay.committed(actor).mark);
    let refused = |cause| IntakeError::Chunk { actor, cause };
    let Some(reserved) = replay.begin(actor, mark).map_err(refused)? else {
        return Ok(Appended::Duplicate);
    };
    let filled = reserved.fill(rows).map_err(refused)?;
    match chunk.standing() {
        Some(words) => filled.standing(&words).commit(),
        None => filled.commit(),
    }
    Ok(Appended::Accepted)
}
