//! What the gate forwards to the learner: exactly the next chunk of each actor, whatever the network does.
//!
//! Chunks are identified by the incarnation and the sequence number in their headers, and ordered by both. A handshake,
//! the first chunk of an incarnation, has sequence number 0. The relay sends it once all chunks before it are committed
//! ([`crate::uncommitted`]). So the gate has at most a window of chunks on their way to the learner, which are all in
//! its channel's history, and a new learner receives them.

use std::collections::VecDeque;

use shoal_common::commit::ChunkId;

/// The gate's decision about a chunk that has arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChunkOrder {
    /// It is the next one: forward it.
    Next,
    /// It was forwarded or committed before.
    Repeated,
    /// A chunk before it is missing. The relay sends both again.
    Early,
}

/// How far the chunks of one actor have been forwarded. Ids of chunks in flight are those in the headers, where a
/// handshake has sequence number 0; the committed id is that in the commit record.
#[derive(Clone, Debug)]
pub struct Forwarding {
    committed: ChunkId,
    /// The ids of the chunks forwarded and not committed, in order.
    in_flight: VecDeque<ChunkId>,
    /// The most of them: as many as the history of the learner's channel has.
    window: usize,
}

impl Forwarding {
    /// Continues after what is committed. At most `window` chunks are forwarded and not committed.
    pub fn new(committed: ChunkId, window: u32) -> Self {
        Self {
            committed,
            in_flight: VecDeque::new(),
            window: window as usize,
        }
    }

    /// The last chunk that was forwarded or committed.
    pub fn last_forwarded(&self) -> ChunkId {
        self.in_flight.back().copied().unwrap_or(self.committed)
    }

    /// The last committed chunk.
    pub fn committed(&self) -> ChunkId {
        self.committed
    }

    /// Whether chunks were forwarded that are not committed.
    pub fn is_waiting(&self) -> bool {
        !self.in_flight.is_empty()
    }

    /// Decides about a chunk. After [`ChunkOrder::Next`], the caller must forward it.
    pub fn offer(&mut self, chunk: ChunkId) -> ChunkOrder {
        let last = self.last_forwarded();
        if chunk <= last {
            return ChunkOrder::Repeated;
        }
        // Only the learner knows the number that a handshake is committed with, and so what follows on it.
        let after_handshake = self.in_flight.back().is_some_and(|before| before.sequence == 0);
        let follows = !after_handshake
            && (chunk.incarnation, Some(chunk.sequence)) == (last.incarnation, last.sequence.checked_add(1));
        let is_handshake = chunk.sequence == 0;
        if self.in_flight.len() >= self.window || !(is_handshake || follows) {
            return ChunkOrder::Early;
        }
        self.in_flight.push_back(chunk);
        ChunkOrder::Next
    }

    /// Takes note of the last committed chunk. One before the last that was noted means that the replay lost its
    /// last chunks in a power loss; forwarding then continues from it.
    pub fn commit(&mut self, committed: ChunkId) {
        if committed < self.committed {
            self.in_flight.clear();
        }
        while self.in_flight.front().is_some_and(|passed| *passed <= committed) {
            self.in_flight.pop_front();
        }
        self.committed = committed;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn id(incarnation: u64, sequence: u64) -> ChunkId {
        ChunkId { incarnation, sequence }
    }

    #[test]
    fn only_the_next_chunk_is_forwarded() {
        let mut forwarding = Forwarding::new(id(7, 4), 2);
        assert_eq!(forwarding.offer(id(7, 6)), ChunkOrder::Early);
        assert_eq!(forwarding.offer(id(7, 5)), ChunkOrder::Next);
        assert_eq!(forwarding.offer(id(7, 5)), ChunkOrder::Repeated);
        assert_eq!(forwarding.offer(id(7, 6)), ChunkOrder::Next);
        assert_eq!(forwarding.last_forwarded(), id(7, 6));
    }

    #[test]
    fn at_most_a_window_is_forwarded_and_not_committed() {
        let mut forwarding = Forwarding::new(id(7, 4), 2);
        assert_eq!(
            [5, 6, 7].map(|n| forwarding.offer(id(7, n))),
            [ChunkOrder::Next, ChunkOrder::Next, ChunkOrder::Early]
        );
        assert_eq!(forwarding.offer(id(8, 0)), ChunkOrder::Early);
        forwarding.commit(id(7, 5));
        assert_eq!(forwarding.offer(id(7, 7)), ChunkOrder::Next);
    }

    #[test]
    fn nothing_follows_a_handshake_before_it_is_committed() {
        let mut forwarding = Forwarding::new(id(7, 4), 2);
        assert_eq!(forwarding.offer(id(9, 0)), ChunkOrder::Next);
        forwarding.commit(id(7, 4));
        assert_eq!(forwarding.offer(id(9, 5)), ChunkOrder::Early);
        assert_eq!(forwarding.offer(id(9, 1)), ChunkOrder::Early);
        forwarding.commit(id(9, 4));
        assert_eq!(forwarding.offer(id(9, 5)), ChunkOrder::Next);
        assert_eq!(forwarding.offer(id(7, 5)), ChunkOrder::Repeated);
    }

    #[test]
    fn a_replay_that_lost_chunks_is_continued_where_it_is() {
        let mut forwarding = Forwarding::new(id(7, 9), 2);
        forwarding.commit(id(7, 6));
        assert_eq!(forwarding.last_forwarded(), id(7, 6));
        assert_eq!(forwarding.offer(id(7, 10)), ChunkOrder::Early);
        assert_eq!(forwarding.offer(id(8, 6)), ChunkOrder::Early);
        assert_eq!(forwarding.offer(id(8, 0)), ChunkOrder::Next);
    }
}
