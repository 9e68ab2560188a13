//! Receives the actors' chunks and appends them to the replay, each exactly once.

use std::collections::BTreeSet;

use shoal_common::channel::transitions::{ChunkReceiver, ReceivedChunk};
use shoal_common::channel::{ChannelError, Domain, EventName, Notifier};
use shoal_common::numbers::are_finite;
use shoal_common::role::Role;
use shoal_common::transition::{ChunkLayout, RowLayout};

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
    #[error(
        "actor {actor} sent a transition with {value} in {part}: the environment or the policy gave a number that is \
             not finite"
    )]
    NotFinite {
        /// The actor that sent it.
        actor: usize,
        /// The part of the transition that has the number.
        part: &'static str,
        /// The number.
        value: f32,
    },
}

/// The receivers of all actors' chunks.
#[derive(Debug)]
pub struct Intake {
    actors: Vec<ActorChunks>,
    /// The receiver of the service that actors on joined hosts share. They need no notification, because the gate reads
    /// the commit record.
    shared: Option<ChunkReceiver>,
    /// The actors that have sent through the shared service. The service gets a turn for each of them.
    sharing: BTreeSet<u32>,
    chunk: ChunkLayout,
    window: u32,
    /// The most rows that the replay may ever have committed; none are taken beyond it.
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

    /// Takes one chunk of each actor in turn, until none is waiting, `max_chunks` of each were taken, or `enough`
    /// returns true. Chunks of actors that share a service are taken in the order in which they come. Returns whether
    /// any chunk was taken.
    ///
    /// # Errors
    /// When a channel fails, or a chunk does not belong to this run.
    pub fn take_in_turn(
        &mut self,
        replay: &mut Replay,
        max_chunks: u32,
        enough: impl Fn(&Replay) -> bool,
    ) -> Result<bool, IntakeError> {
        let shared_turns = usize::from(self.shared.is_some()).max(self.sharing.len());
        let turns = self.actors.len() + shared_turns;
        let (mut any, mut idle) = (false, 0);
        for _ in 0..u64::from(max_chunks) * turns as u64 {
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
    let refused = |cause| IntakeError::Chunk { actor, cause };
    let actors = replay.layout().actors;
    if actor >= actors {
        return Err(refused(ChunkError::Actor { actor, actors }));
    }
    let rows = &chunk.rows()[..numbers];
    if !are_finite(rows) {
        let layout = replay.layout().row;
        let bad = rows.iter().position(|number| !number.is_finite()).unwrap_or_default();
        return Err(IntakeError::NotFinite {
            actor,
            part: part_of_row(layout, bad % layout.width()),
            value: rows[bad],
        });
    }
    let id = chunk.id(replay.committed(actor).last_chunk);
    let Some(reserved) = replay.reserve(actor, id).map_err(refused)? else {
        return Ok(Appended::Duplicate);
    };
    let filled = reserved.fill(rows).map_err(refused)?;
    match chunk.actor_snapshot() {
        Some(words) => filled.with_snapshot(&words).commit(),
        None => filled.commit(),
    }
    Ok(Appended::Accepted)
}

/// The part of a row that has this number, in words.
fn part_of_row(layout: RowLayout, number: usize) -> &'static str {
    let (observation, action) = (layout.observation_width(), layout.action_width());
    let reward = observation + action;
    match number {
        n if n < observation => "the observation",
        n if n < reward => "the action",
        n if n == reward => "the reward",
        n if n == reward + 1 => "the discount",
        n if n < layout.width() - 1 => "the next observation",
        _ => "the mark of the episode's end",
    }
}

#[cfg(test)]
mod tests {
    use shoal_common::channel::Services;
    use shoal_common::channel::transitions::ChunkSender;
    use shoal_common::transition::Transition;

    use super::*;
    use crate::replay::ReplayLayout;

    #[test]
    fn a_chunk_of_an_actor_that_the_replay_does_not_have_is_refused() {
        let domain = Domain::join(&format!("intake{:x}", std::process::id()), 2).unwrap();
        let mut services = Services::new(&domain).unwrap();
        (0..2).for_each(|actor| services.create_actor(&domain, actor, 2).unwrap());
        let chunk = ChunkLayout {
            row: RowLayout::new(1, 1),
            rows: 4,
            actor_snapshot_words: 0,
        };
        let directory = tempfile::tempdir().unwrap();
        let layout = ReplayLayout {
            row: chunk.row,
            ring: 10,
            actors: 1,
            actor_snapshot_words: 0,
            fingerprint: 0,
        };
        let mut replay = Replay::create(&directory.path().join("replay"), &layout).unwrap();
        let intake = Intake::open(&domain, 2, 2, chunk, 100).unwrap();
        let handshakes = [0, 1].map(|actor| ChunkSender::open(&domain, actor, 1, chunk, 2).unwrap());
        assert_eq!(intake.take_from(0, &mut replay).unwrap(), Some(Appended::Accepted));
        let refused = intake.take_from(1, &mut replay).unwrap_err();
        assert!(
            matches!(
                refused,
                IntakeError::Chunk {
                    actor: 1,
                    cause: ChunkError::Actor { actor: 1, actors: 1 }
                }
            ),
            "{refused}"
        );
        drop((handshakes, intake, services));
        domain.leave().unwrap();
    }

    #[test]
    fn each_number_of_a_row_belongs_to_a_part_of_the_transition() {
        let layout = RowLayout::new(2, 1);
        let mut row = vec![0.0; layout.width()];
        let transition = Transition {
            s: &[1.0, 1.0],
            a: &[2.0],
            r: 3.0,
            discount: 4.0,
            s_next: &[5.0, 5.0],
            last: true,
        };
        layout.write(&transition, &mut row);
        let parts: Vec<&str> = (0..row.len()).map(|number| part_of_row(layout, number)).collect();
        for (part, value) in [
            ("the observation", 1.0),
            ("the action", 2.0),
            ("the reward", 3.0),
            ("the discount", 4.0),
            ("the next observation", 5.0),
        ] {
            let has_value: Vec<bool> = row.iter().map(|number| *number == value).collect();
            let is_part: Vec<bool> = parts.iter().map(|found| *found == part).collect();
            assert_eq!(&is_part[..row.len() - 1], &has_value[..row.len() - 1], "{part}");
        }
        assert_eq!(parts.last(), Some(&"the mark of the episode's end"));
    }
}
