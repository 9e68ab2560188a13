//! How a chunk becomes part of the replay: reserved, filled, committed, each step a type that the next one consumes.

use std::sync::atomic::{Ordering, compiler_fence, fence};

use shoal_common::commit::ChunkMark;

use super::error::ChunkError;
use super::step::{WriteStep, observe};
use super::store::Replay;

/// What became of a chunk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Appended {
    /// It is committed now.
    Accepted,
    /// It, or a later one of its actor, had been committed before; nothing was done.
    Duplicate,
}

/// A chunk that is new and has no rows yet.
#[must_use = "nothing is in the replay before `commit`"]
#[derive(Debug)]
pub struct Reserved<'a> {
    replay: &'a mut Replay,
    actor: usize,
    mark: ChunkMark,
}

/// A chunk whose rows stand in the ring, beyond what is committed.
#[must_use = "nothing is in the replay before `commit`"]
#[derive(Debug)]
pub struct Filled<'a> {
    chunk: Reserved<'a>,
    rows: u64,
}

impl Replay {
    /// Starts a chunk, or gives `None` if it or a later one of its actor was committed before.
    ///
    /// # Errors
    /// When the actor is unknown, or the chunk is not the one that comes next: that has the next sequence number of the same
    /// incarnation, or is a later incarnation's first, which has no rows and leaves the sequence as it is.
    pub fn begin(&mut self, actor: usize, mark: ChunkMark) -> Result<Option<Reserved<'_>>, ChunkError> {
        let actors = self.layout.actors;
        if actor >= actors {
            return Err(ChunkError::Actor { actor, actors });
        }
        let committed = self.record.actor(actor).mark;
        if mark <= committed {
            return Ok(None);
        }
        if !mark.is_next(committed) {
            return Err(ChunkError::OutOfOrder { actor, mark, committed });
        }
        Ok(Some(Reserved {
            replay: self,
            actor,
            mark,
        }))
    }

    /// Starts, fills and commits a chunk in one call.
    pub fn append_and_commit(&mut self, actor: usize, mark: ChunkMark, rows: &[f32]) -> Result<Appended, ChunkError> {
        match self.begin(actor, mark)? {
            Some(chunk) => {
                chunk.fill(rows)?.commit();
                Ok(Appended::Accepted)
            }
            None => Ok(Appended::Duplicate),
        }
    }
}

impl<'a> Reserved<'a> {
    /// Copies the chunk's rows into the ring, over the oldest ones. On error nothing was touched.
    pub fn fill(self, numbers: &[f32]) -> Result<Filled<'a>, ChunkError> {
        let Replay {
            layout,
            places,
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
        // Before the first row is overwritten, so that who opens the file after a kill knows why those rows are gone.
        words.store(places.reach, head + rows);
        record.set_tail(record.tail().max((head + rows).saturating_sub(layout.ring)));
        compiler_fence(Ordering::SeqCst);
        observe(hook, WriteStep::ReachSet);
        ring.put(head, numbers, |step| observe(hook, step));
        // The rows stand in the file before a record can name them: for the file's sake, no reader looks at rows.
        fence(Ordering::Release);
        Ok(Filled { chunk: self, rows })
    }
}

impl Filled<'_> {
    /// Says where the actor stands after the chunk, in as many words as the layout has; otherwise it stays as it was.
    ///
    /// # Panics
    /// As `copy_from_slice` does when there are more or fewer.
    pub fn standing(self, words: &[u64]) -> Self {
        self.chunk.replay.record.set_standing(self.chunk.actor, words);
        self
    }

    /// Makes the chunk part of the replay.
    pub fn commit(self) {
        let Reserved { replay, actor, mark } = self.chunk;
        replay.record.add(actor, mark, self.rows);
        replay.publish(replay.record.generation() + 1);
    }
}
