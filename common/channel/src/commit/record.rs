//! The commit record: which rows and which chunks are in the replay.

use std::sync::atomic::{Ordering, fence};

use serde::{Deserialize, Serialize};
use shoal_base::numbers::COUNTER_LIMIT;

use super::layout::{ACTOR_WORDS, RECORD_WORDS, ReplayLayout};
use super::words::{Words, WritableWords};

/// Identifies a chunk of one actor. Ids are ordered by incarnation, then by sequence number.
///
/// The default means "none": incarnations and sequence numbers count from 1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct ChunkId {
    /// Grows with every process that the run starts.
    pub incarnation: u64,
    /// The chunk's number, over all of the actor's incarnations. A handshake has no number of its own: in its header it
    /// is 0, and in a record it is that of the chunk before it (`ReceivedChunk::id` converts).
    pub sequence: u64,
}

/// The greatest incarnation that is accepted.
pub const MAX_INCARNATION: u64 = COUNTER_LIMIT;

impl ChunkId {
    /// Whether this chunk comes right after `committed`: it has the next sequence number of the same incarnation, or it
    /// is the handshake of a later incarnation, which keeps the sequence number.
    pub fn is_next(self, committed: Self) -> bool {
        let Self { incarnation, sequence } = self;
        if incarnation == committed.incarnation {
            committed.sequence.checked_add(1) == Some(sequence)
        } else {
            (committed.incarnation..=MAX_INCARNATION).contains(&incarnation) && sequence == committed.sequence
        }
    }
}

/// What is committed of one actor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ActorCommit {
    /// The last chunk.
    pub last_chunk: ChunkId,
    /// Rows of all its chunks, over all incarnations.
    pub rows: u64,
}

/// A commit record. Rows are numbered from 0 in the order they were committed, for the life of the file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct CommitRecord {
    /// Exactly as in a slot: the three fields below, then for each actor three words and its snapshot.
    words: Vec<u64>,
    /// Words of an actor.
    stride: usize,
}

const GENERATION: usize = 0;
const HEAD: usize = 1;
const TAIL: usize = 2;
/// Index of the actors' first word.
const ACTORS: usize = RECORD_WORDS;

const WORD: usize = size_of::<u64>();
/// The seal of a slot whose record is being written. No finished record has it: see `seal`.
const OPEN: u64 = 0;

impl CommitRecord {
    /// The record of an empty replay of this layout, which must have [`offsets`](ReplayLayout::offsets).
    pub fn empty(layout: &ReplayLayout) -> Self {
        let stride = ACTOR_WORDS + layout.actor_snapshot_words;
        Self {
            words: vec![0; ACTORS + stride * layout.actors],
            stride,
        }
    }

    /// The record's number; a newer record has a greater one.
    pub fn generation(&self) -> u64 {
        self.words[GENERATION]
    }

    /// Rows committed over the life of the file, which is also the number of the next row.
    pub fn head(&self) -> u64 {
        self.words[HEAD]
    }

    /// Number of the oldest row that can be read. Earlier rows were overwritten or lost.
    pub fn tail(&self) -> u64 {
        self.words[TAIL]
    }

    /// Number of actors that the record has space for.
    pub fn actors(&self) -> usize {
        (self.words.len() - ACTORS) / self.stride
    }

    /// What is committed of an actor.
    ///
    /// # Panics
    /// If `actor` is not less than `actors()`.
    pub fn actor(&self, actor: usize) -> ActorCommit {
        actor_from(|i| self.words[ACTORS + self.stride * actor + i])
    }

    /// Adds a chunk.
    ///
    /// # Panics
    /// If `actor` is not less than `actors()`.
    pub fn add(&mut self, actor: usize, id: ChunkId, rows: u64) {
        let at = ACTORS + self.stride * actor;
        self.words[at] = id.incarnation;
        self.words[at + 1] = id.sequence;
        self.words[at + 2] += rows;
        self.words[HEAD] += rows;
    }

    /// Adds initial rows, which belong to no actor.
    pub fn add_initial_rows(&mut self, rows: u64) {
        self.words[HEAD] += rows;
    }

    /// Sets what is committed of an actor, in a record that mirrors another one.
    ///
    /// # Panics
    /// If `actor` is not less than `actors()`.
    pub(super) fn set_actor(&mut self, actor: usize, commit: ActorCommit) {
        let at = ACTORS + self.stride * actor;
        self.words[at] = commit.last_chunk.incarnation;
        self.words[at + 1] = commit.last_chunk.sequence;
        self.words[at + 2] = commit.rows;
    }

    /// Sets the number of rows committed, in a record that mirrors another one.
    pub(super) fn set_head(&mut self, rows: u64) {
        self.words[HEAD] = rows;
        self.words[TAIL] = self.words[TAIL].min(rows);
    }

    /// An actor's snapshot after its last chunk; zeros before the first.
    ///
    /// # Panics
    /// If `actor` is not less than `actors()`.
    pub fn actor_snapshot(&self, actor: usize) -> &[u64] {
        &self.words[ACTORS + self.stride * actor..][..self.stride][ACTOR_WORDS..]
    }

    /// Sets an actor's snapshot.
    ///
    /// # Panics
    /// If there are not exactly as many words as the layout requires, or `actor` is not less than `actors()`.
    pub fn set_actor_snapshot(&mut self, actor: usize, words: &[u64]) {
        self.words[ACTORS + self.stride * actor..][..self.stride][ACTOR_WORDS..].copy_from_slice(words);
    }

    /// Sets the generation.
    pub fn set_generation(&mut self, generation: u64) {
        self.words[GENERATION] = generation;
    }

    /// Gives up the rows before `tail`.
    pub fn set_tail(&mut self, tail: u64) {
        self.words[TAIL] = tail;
    }

    /// The seal of this record, once finished. It is never `OPEN`, so that an unfinished record is recognised by more
    /// than its checksum.
    fn seal(&self) -> u64 {
        1 << 32 | u64::from(crc32fast::hash(bytemuck::cast_slice(&self.words)))
    }

    /// Reads the record of the slot at `offset`; `None` if it was not finished or is damaged.
    pub fn load(words: &Words, offset: usize, layout: &ReplayLayout) -> Option<Self> {
        let mut record = Self::empty(layout);
        for (i, word) in record.words.iter_mut().enumerate() {
            *word = words.load(offset + (1 + i) * WORD);
        }
        // No actor has more rows than all actors together.
        let possible = record.tail() <= record.head()
            && record.head().max(record.generation()) < COUNTER_LIMIT
            && (0..layout.actors).all(|actor| record.actor(actor).rows <= record.head());
        (words.load(offset) == record.seal() && possible).then_some(record)
    }

    /// Writes the record into the slot at `offset`, which must not be the active one. `step` is called after each of
    /// the three steps: seal cleared, record written, seal set. Later stores are ordered after all of these.
    pub fn store(&self, words: &mut WritableWords, offset: usize, mut step: impl FnMut(usize)) {
        // SYNC POINT with the second Acquire fence of `CommitReader::consistent`: a reader that has read a word stored
        // below also sees the newer generation, which was published before.
        fence(Ordering::Release);
        words.store(offset, OPEN);
        step(0);
        // This fence and the next are for a process that opens the file after a kill: a sealed slot must be complete.
        fence(Ordering::Release);
        for (i, word) in self.words.iter().enumerate() {
            words.store(offset + (1 + i) * WORD, *word);
        }
        step(1);
        fence(Ordering::Release);
        words.store(offset, self.seal());
        step(2);
        // SYNC POINT with the first Acquire fence of `CommitReader::consistent`: the caller publishes the generation
        // next.
        fence(Ordering::Release);
    }
}

/// Number of rows committed, according to the record in the slot at `offset`.
pub(super) fn load_head(words: &Words, offset: usize) -> u64 {
    words.load(offset + (1 + HEAD) * WORD)
}

/// What is committed of an actor, according to the record in the slot at `offset`.
pub(super) fn load_actor(words: &Words, offset: usize, layout: &ReplayLayout, actor: usize) -> ActorCommit {
    let stride = ACTOR_WORDS + layout.actor_snapshot_words;
    actor_from(|i| words.load(offset + (1 + ACTORS + stride * actor + i) * WORD))
}

fn actor_from(word: impl Fn(usize) -> u64) -> ActorCommit {
    ActorCommit {
        last_chunk: ChunkId {
            incarnation: word(0),
            sequence: word(1),
        },
        rows: word(2),
    }
}
