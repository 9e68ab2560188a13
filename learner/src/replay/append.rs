//! Appending a chunk in three steps: reserved, filled, committed. Each step is a type that the next one consumes.

use std::sync::atomic::{Ordering, compiler_fence, fence};

use shoal_common::commit::ChunkId;

use super::error::ChunkError;
use super::step::{WriteStep, observe};
use super::store::Replay;

/// The result of appending a chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Appended {
    /// It is now committed.
    Accepted,
    /// It, or a later chunk of its actor, was committed before; nothing was done.
    Duplicate,
}

/// A chunk that is new and has no rows yet.
#[must_use = "nothing is in the replay before `commit`"]
#[derive(Debug)]
pub struct ReservedChunk<'a> {
    replay: &'a mut Replay,
    actor: usize,
    id: ChunkId,
}

/// A chunk whose rows are in the ring but not committed.
#[must_use = "nothing is in the replay before `commit`"]
#[derive(Debug)]
pub struct FilledChunk<'a> {
    chunk: ReservedChunk<'a>,
    rows: u64,
}

impl Replay {
    /// Reserves the place of a chunk. Returns `None` if it or a later one of its actor was committed before.
    ///
    /// # Errors
    /// When the actor is unknown, or the chunk is not the next one. The next one has the same incarnation and the next
    /// sequence number, or it is the first of a later incarnation, which has no rows and keeps the sequence number.
    pub fn reserve(&mut self, actor: usize, id: ChunkId) -> Result<Option<ReservedChunk<'_>>, ChunkError> {
        let actors = self.layout.actors;
        if actor >= actors {
            return Err(ChunkError::Actor { actor, actors });
        }
        let committed = self.record.actor(actor).last_chunk;
        if id <= committed {
            return Ok(None);
        }
        if !id.is_next(committed) {
            return Err(ChunkError::OutOfOrder { actor, id, committed });
        }
        Ok(Some(ReservedChunk {
            replay: self,
            actor,
            id,
        }))
    }

    /// Reserves, fills and commits a chunk in one call.
    pub fn append_and_commit(&mut self, actor: usize, id: ChunkId, rows: &[f32]) -> Result<Appended, ChunkError> {
        match self.reserve(actor, id)? {
            Some(chunk) => {
                chunk.fill(rows)?.commit();
                Ok(Appended::Accepted)
            }
            None => Ok(Appended::Duplicate),
        }
    }
}

impl<'a> ReservedChunk<'a> {
    /// Copies the chunk's rows into the ring, over the oldest ones. On an error nothing has changed.
    pub fn fill(self, numbers: &[f32]) -> Result<FilledChunk<'a>, ChunkError> {
        let Replay {
            layout,
            offsets,
            words,
            ring,
            record,
            hook,
            ..
        } = &mut *self.replay;
        let width = layout.row.width();
        if !numbers.len().is_multiple_of(width) {
            return Err(ChunkError::Ragged {
                actor: self.actor,
                numbers: numbers.len(),
                width,
            });
        }
        let rows = (numbers.len() / width) as u64;
        if rows > layout.ring {
            return Err(ChunkError::TooLong {
                actor: self.actor,
                rows,
                ring: layout.ring,
            });
        }
        let head = record.head();
        // Set before the first row is overwritten, so that recovery after a kill can tell why these rows are gone.
        words.store(offsets.write_horizon, head + rows);
        record.set_tail(record.tail().max((head + rows).saturating_sub(layout.ring)));
        compiler_fence(Ordering::SeqCst);
        observe(hook, WriteStep::WriteHorizonSet);
        ring.put(head, numbers, |step| observe(hook, step));
        // The rows are in the file before a record names them. This is for recovery: no reader reads rows.
        fence(Ordering::Release);
        Ok(FilledChunk { chunk: self, rows })
    }
}

impl FilledChunk<'_> {
    /// Sets the actor's snapshot after the chunk, in as many words as the layout has. Without this call, the previous
    /// snapshot stays.
    ///
    /// # Panics
    /// If there are more or fewer words.
    pub fn with_snapshot(self, words: &[u64]) -> Self {
        self.chunk.replay.record.set_actor_snapshot(self.chunk.actor, words);
        self
    }

    /// Makes the chunk part of the replay.
    pub fn commit(self) {
        let ReservedChunk { replay, actor, id } = self.chunk;
        replay.record.add(actor, id, self.rows);
        replay.publish(replay.record.generation() + 1);
    }
}
