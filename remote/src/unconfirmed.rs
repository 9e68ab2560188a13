//! What the relay keeps: the chunks of one actor that are not committed, and which of them to send next.
//!
//! This is the sending half of go-back-N. The relay sends each chunk once, and goes back to what the gate has got when
//! the gate stands still for too long, or is another process. A chunk is kept until it is committed, because the gate and
//! the learner keep nothing over their own ends that the replay does not have.

use std::collections::VecDeque;
use std::time::Duration;

use shoal_common::commit::ChunkMark;

/// What the relay must do about an actor after a mark of the gate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Consequence {
    /// Nothing.
    Continue,
    /// The replay has lost chunks that were committed, and the next chunks of the actor do not follow on what it has. End
    /// the actor unless it has a later incarnation than this; its successor begins with a handshake.
    StartAgain(u64),
    /// Another host has the actor's index now: end the actor for good.
    TakenOver,
}

/// The chunks of one actor that are not committed. `C` is the chunk itself.
#[derive(Debug)]
pub struct Unconfirmed<C> {
    chunks: VecDeque<Kept<C>>,
    /// Index of the next chunk to send.
    next: usize,
    committed: ChunkMark,
    /// The last chunk that the gate is known to have.
    got: ChunkMark,
    /// The last chunk that was added.
    newest: ChunkMark,
    /// When the gate last got a new chunk, or there was nothing to get.
    moved: Duration,
    /// Chunks that were sent more than once.
    resent: u64,
    /// The furthest chunk that was sent.
    sent: ChunkMark,
}

/// A chunk to be sent.
#[derive(Debug)]
pub struct Kept<C> {
    /// The numbers in its header.
    pub mark: ChunkMark,
    /// Those of the chunk before it.
    previous: ChunkMark,
    /// The chunk.
    pub chunk: C,
}

impl<C> Kept<C> {
    fn is_handshake(&self) -> bool {
        self.mark.sequence == 0
    }
}

impl<C> Unconfirmed<C> {
    /// Nothing is kept, and this is committed.
    pub fn new(committed: ChunkMark) -> Self {
        Self {
            chunks: VecDeque::new(),
            next: 0,
            committed,
            got: committed,
            newest: committed,
            moved: Duration::ZERO,
            resent: 0,
            sent: committed,
        }
    }

    /// The newest committed mark.
    pub fn committed(&self) -> ChunkMark {
        self.committed
    }

    /// Chunks that are kept.
    pub fn len(&self) -> usize {
        self.chunks.len()
    }

    /// Whether no chunk is kept.
    pub fn is_empty(&self) -> bool {
        self.chunks.is_empty()
    }

    /// How often a chunk was sent again.
    pub fn resent(&self) -> u64 {
        self.resent
    }

    /// Adds a chunk of the actor. A window of chunks and a handshake are kept at most, or twice
    /// that after a power loss. One that was added or committed
    /// before is ignored, because a new relay receives the history of the actor's channel; so is one that does not follow
    /// on the others.
    pub fn add(&mut self, mark: ChunkMark, chunk: C, now: Duration) -> Consequence {
        if mark <= self.newest {
            return Consequence::Continue;
        }
        let follows = mark.incarnation == self.newest.incarnation && mark.sequence - self.newest.sequence == 1;
        if mark.sequence > 0 && !follows {
            return Consequence::StartAgain(mark.incarnation);
        }
        let mut previous = self.newest;
        // An actor that ended before its handshake was committed has sent nothing else.
        if mark.sequence == 0
            && self.chunks.back().is_some_and(Kept::is_handshake)
            && let Some(unused) = self.chunks.pop_back()
        {
            previous = unused.previous;
            self.next = self.next.min(self.chunks.len());
        }
        if self.next == self.chunks.len() {
            self.moved = now;
        }
        self.chunks.push_back(Kept { mark, previous, chunk });
        self.newest = mark;
        Consequence::Continue
    }

    /// The next chunk to send. It stays the next one until [`sent`](Self::sent) is called. A handshake waits until all
    /// chunks before it are committed: its number does not tell the gate whether one is missing.
    pub fn next(&self) -> Option<&Kept<C>> {
        let next = self.chunks.get(self.next);
        next.filter(|kept| !kept.is_handshake() || kept.previous <= self.committed)
    }

    /// Takes note that the next chunk was sent.
    pub fn sent(&mut self) {
        if let Some(kept) = self.chunks.get(self.next) {
            if kept.mark <= self.sent {
                self.resent += 1;
            }
            self.sent = self.sent.max(kept.mark);
            self.next += 1;
        }
    }

    /// Takes note of what the gate has got, and of what is committed. This host's processes have incarnations below
    /// `limit`, and every process that was started elsewhere later has one that is not.
    pub fn confirm(&mut self, got: ChunkMark, committed: ChunkMark, limit: u64, now: Duration) -> Consequence {
        if committed < self.committed {
            let ended = self.newest.incarnation;
            *self = Self {
                moved: now,
                resent: self.resent,
                ..Self::new(committed)
            };
            return Consequence::StartAgain(ended);
        }
        if got > self.got {
            self.moved = now;
        }
        self.got = got;
        self.committed = committed;
        self.newest = self.newest.max(committed);
        let confirmed = self.chunks.partition_point(|kept| kept.mark <= committed);
        self.chunks.drain(..confirmed);
        self.next = self.next.saturating_sub(confirmed);
        if committed.incarnation >= limit {
            return Consequence::TakenOver;
        }
        Consequence::Continue
    }

    /// Whether the gate has got all chunks.
    pub fn all_got(&self) -> bool {
        self.chunks.back().is_none_or(|kept| kept.mark <= self.got)
    }

    /// Goes back to the first chunk that the gate has not got, if it has got none for `patience` although some were sent.
    pub fn go_back_if_overdue(&mut self, now: Duration, patience: Duration) {
        let outstanding = self.next > 0 && self.chunks[self.next - 1].mark > self.got;
        if !outstanding {
            self.moved = now;
        } else if now.saturating_sub(self.moved) >= patience {
            self.go_back(now);
        }
    }

    /// Goes back to the first chunk that the gate has not got: it is another process than before.
    pub fn go_back(&mut self, now: Duration) {
        self.next = self.chunks.partition_point(|kept| kept.mark <= self.got);
        self.moved = now;
    }
}
