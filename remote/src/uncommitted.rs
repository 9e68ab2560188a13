//! What the relay keeps: the chunks of one actor that are not committed, and which of them to send next.
//!
//! This is the sending half of go-back-N. The relay sends each chunk once, and sends again from the first one that the
//! gate has not forwarded, if the gate has forwarded nothing for too long or was restarted. A chunk is kept until it is
//! committed: when gate or learner end, they lose all that is not in the replay.

use std::collections::VecDeque;
use std::time::Duration;

use shoal_common::commit::ChunkId;

/// What the relay must do about an actor after an acknowledgement of the gate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ActorFollowUp {
    /// Nothing.
    Continue,
    /// The replay has lost chunks that were committed, and the next chunks of the actor do not follow on what it has.
    /// End the actor unless it has a later incarnation than this; its successor begins with a handshake.
    Restart(u64),
    /// A process of another host has committed chunks with the actor's index: this host has lost its actors.
    TakenOver,
}

/// The chunks of one actor that are not committed. `C` is the chunk itself.
#[derive(Debug)]
pub struct UncommittedChunks<C> {
    chunks: VecDeque<KeptChunk<C>>,
    /// Index of the next chunk to send.
    next_to_send: usize,
    committed: ChunkId,
    /// The last chunk that the gate has acknowledged as forwarded.
    forwarded: ChunkId,
    /// The last chunk that was added.
    newest_added: ChunkId,
    /// When the gate last forwarded a new chunk, or there was nothing to forward.
    progress_at: Duration,
    /// Chunks that were sent more than once.
    resent: u64,
    /// The last chunk that was ever sent; later sendings of it or of earlier ones are repetitions.
    furthest_sent: ChunkId,
}

/// A chunk to be sent. Its ids are those in the headers, where a handshake has sequence number 0.
#[derive(Debug)]
pub struct KeptChunk<C> {
    /// Its id.
    pub id: ChunkId,
    /// The id of the chunk before it.
    previous: ChunkId,
    /// The chunk.
    pub chunk: C,
}

impl<C> KeptChunk<C> {
    fn is_handshake(&self) -> bool {
        self.id.sequence == 0
    }
}

impl<C> UncommittedChunks<C> {
    /// Nothing is kept, and this is committed.
    pub fn new(committed: ChunkId) -> Self {
        Self {
            chunks: VecDeque::new(),
            next_to_send: 0,
            committed,
            forwarded: committed,
            newest_added: committed,
            progress_at: Duration::ZERO,
            resent: 0,
            furthest_sent: committed,
        }
    }

    /// The last committed chunk.
    pub fn committed(&self) -> ChunkId {
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

    /// Adds a chunk of the actor. At most a window of chunks and a handshake are kept; twice that after a power
    /// loss. One that was added or committed before is ignored, because a new relay receives the history of the actor's
    /// channel; so is one that does not follow on the others.
    pub fn add(&mut self, id: ChunkId, chunk: C, now: Duration) -> ActorFollowUp {
        if id <= self.newest_added {
            return ActorFollowUp::Continue;
        }
        let follows = id.incarnation == self.newest_added.incarnation && id.sequence - self.newest_added.sequence == 1;
        if id.sequence > 0 && !follows {
            return ActorFollowUp::Restart(id.incarnation);
        }
        let mut previous = self.newest_added;
        // An actor that ended before its handshake was committed has sent nothing else.
        if id.sequence == 0
            && self.chunks.back().is_some_and(KeptChunk::is_handshake)
            && let Some(unused) = self.chunks.pop_back()
        {
            previous = unused.previous;
            self.next_to_send = self.next_to_send.min(self.chunks.len());
        }
        if self.next_to_send == self.chunks.len() {
            self.progress_at = now;
        }
        self.chunks.push_back(KeptChunk { id, previous, chunk });
        self.newest_added = id;
        ActorFollowUp::Continue
    }

    /// The next chunk to send. It stays the next one until [`note_sent`](Self::note_sent) is called. A handshake waits
    /// until all chunks before it are committed: its number does not tell the gate whether one is missing.
    pub fn next(&self) -> Option<&KeptChunk<C>> {
        let next = self.chunks.get(self.next_to_send);
        next.filter(|kept| !kept.is_handshake() || kept.previous <= self.committed)
    }

    /// Takes note that the next chunk was sent.
    pub fn note_sent(&mut self) {
        if let Some(kept) = self.chunks.get(self.next_to_send) {
            if kept.id <= self.furthest_sent {
                self.resent += 1;
            }
            self.furthest_sent = self.furthest_sent.max(kept.id);
            self.next_to_send += 1;
        }
    }

    /// Takes note of what the gate has forwarded, and of what is committed. This host's processes have incarnations
    /// below `limit`, and every process that was started elsewhere later has one that is not.
    pub fn acknowledge(&mut self, forwarded: ChunkId, committed: ChunkId, limit: u64, now: Duration) -> ActorFollowUp {
        if committed < self.committed {
            let ended = self.newest_added.incarnation;
            *self = Self {
                progress_at: now,
                resent: self.resent,
                ..Self::new(committed)
            };
            return ActorFollowUp::Restart(ended);
        }
        if forwarded > self.forwarded {
            self.progress_at = now;
        }
        self.forwarded = forwarded;
        self.committed = committed;
        self.newest_added = self.newest_added.max(committed);
        let confirmed = self.chunks.partition_point(|kept| kept.id <= committed);
        self.chunks.drain(..confirmed);
        self.next_to_send = self.next_to_send.saturating_sub(confirmed);
        if committed.incarnation >= limit {
            return ActorFollowUp::TakenOver;
        }
        ActorFollowUp::Continue
    }

    /// Whether the gate has forwarded all chunks.
    pub fn all_forwarded(&self) -> bool {
        self.chunks.back().is_none_or(|kept| kept.id <= self.forwarded)
    }

    /// Goes back to the first chunk that the gate has not forwarded, if it has forwarded none for `timeout` although
    /// some were sent.
    pub fn go_back_if_overdue(&mut self, now: Duration, timeout: Duration) {
        let outstanding = self.next_to_send > 0 && self.chunks[self.next_to_send - 1].id > self.forwarded;
        if !outstanding {
            self.progress_at = now;
        } else if now.saturating_sub(self.progress_at) >= timeout {
            self.go_back(now);
        }
    }

    /// Goes back to the first chunk that the gate has not forwarded. Call it when the gate was restarted.
    pub fn go_back(&mut self, now: Duration) {
        self.next_to_send = self.chunks.partition_point(|kept| kept.id <= self.forwarded);
        self.progress_at = now;
    }
}
