//! What the gate passes on to the learner: of each actor exactly the next chunk, whatever the network does.
//!
//! Chunks are identified by the incarnation and the sequence number in their headers, and ordered by both. A handshake,
//! the first chunk of an incarnation, has sequence number 0. The relay sends it once all chunks before it are committed
//! ([`crate::unconfirmed`]). So the gate has at most a window of chunks on their way to the learner, which are all in its
//! channel's history, and a new learner receives them.

use std::collections::VecDeque;

use shoal_common::commit::ChunkMark;

/// The gate's decision about a chunk that has arrived.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Offer {
    /// It is the next one: pass it on.
    Next,
    /// It was passed on or committed before.
    Repeated,
    /// A chunk before it is missing. The relay sends both again.
    Early,
}

/// How far the chunks of one actor have been passed on.
#[derive(Clone, Debug)]
pub struct Forwarding {
    committed: ChunkMark,
    /// The numbers in the headers of the chunks passed on and not committed, in order.
    passed: VecDeque<ChunkMark>,
    /// The most of them: as many as the history of the learner's channel has.
    window: usize,
}

impl Forwarding {
    /// Continues after what is committed. At most `window` chunks are passed on and not committed.
    pub fn new(committed: ChunkMark, window: u32) -> Self {
        Self {
            committed,
            passed: VecDeque::new(),
            window: window as usize,
        }
    }

    /// The last chunk that was passed on or committed.
    pub fn got(&self) -> ChunkMark {
        self.passed.back().copied().unwrap_or(self.committed)
    }

    /// The newest committed mark.
    pub fn committed(&self) -> ChunkMark {
        self.committed
    }

    /// Whether chunks were passed on that are not committed.
    pub fn is_waiting(&self) -> bool {
        !self.passed.is_empty()
    }

    /// Decides about a chunk. After [`Offer::Next`], the caller must pass it on.
    pub fn offer(&mut self, chunk: ChunkMark) -> Offer {
        let got = self.got();
        if chunk <= got {
            return Offer::Repeated;
        }
        // Only the learner knows the number that a handshake is committed with, and so what follows on it.
        let after_handshake = self.passed.back().is_some_and(|last| last.sequence == 0);
        let follows = !after_handshake
            && (chunk.incarnation, Some(chunk.sequence)) == (got.incarnation, got.sequence.checked_add(1));
        let is_handshake = chunk.sequence == 0;
        if self.passed.len() >= self.window || !(is_handshake || follows) {
            return Offer::Early;
        }
        self.passed.push_back(chunk);
        Offer::Next
    }

    /// Takes note of the newest committed mark. A mark that is older than an earlier one means that the replay lost its
    /// last chunks in a power loss; forwarding then continues from it.
    pub fn commit(&mut self, committed: ChunkMark) {
        if committed < self.committed {
            self.passed.clear();
        }
        while self.passed.front().is_some_and(|passed| *passed <= committed) {
            self.passed.pop_front();
        }
        self.committed = committed;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mark(incarnation: u64, sequence: u64) -> ChunkMark {
        ChunkMark { incarnation, sequence }
    }

    #[test]
    fn only_the_next_chunk_is_passed_on() {
        let mut forwarding = Forwarding::new(mark(7, 4), 2);
        assert_eq!(forwarding.offer(mark(7, 6)), Offer::Early);
        assert_eq!(forwarding.offer(mark(7, 5)), Offer::Next);
        assert_eq!(forwarding.offer(mark(7, 5)), Offer::Repeated);
        assert_eq!(forwarding.offer(mark(7, 6)), Offer::Next);
        assert_eq!(forwarding.got(), mark(7, 6));
    }

    #[test]
    fn at_most_a_window_is_passed_on_and_not_committed() {
        let mut forwarding = Forwarding::new(mark(7, 4), 2);
        assert_eq!(
            [5, 6, 7].map(|n| forwarding.offer(mark(7, n))),
            [Offer::Next, Offer::Next, Offer::Early]
        );
        assert_eq!(forwarding.offer(mark(8, 0)), Offer::Early);
        forwarding.commit(mark(7, 5));
        assert_eq!(forwarding.offer(mark(7, 7)), Offer::Next);
    }

    #[test]
    fn nothing_follows_a_handshake_before_it_is_committed() {
        let mut forwarding = Forwarding::new(mark(7, 4), 2);
        assert_eq!(forwarding.offer(mark(9, 0)), Offer::Next);
        forwarding.commit(mark(7, 4));
        assert_eq!(forwarding.offer(mark(9, 5)), Offer::Early);
        assert_eq!(forwarding.offer(mark(9, 1)), Offer::Early);
        forwarding.commit(mark(9, 4));
        assert_eq!(forwarding.offer(mark(9, 5)), Offer::Next);
        assert_eq!(forwarding.offer(mark(7, 5)), Offer::Repeated);
    }

    #[test]
    fn a_replay_that_lost_chunks_is_continued_where_it_is() {
        let mut forwarding = Forwarding::new(mark(7, 9), 2);
        forwarding.commit(mark(7, 6));
        assert_eq!(forwarding.got(), mark(7, 6));
        assert_eq!(forwarding.offer(mark(7, 10)), Offer::Early);
        assert_eq!(forwarding.offer(mark(8, 6)), Offer::Early);
        assert_eq!(forwarding.offer(mark(8, 0)), Offer::Next);
    }
}
