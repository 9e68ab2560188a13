//! The initial rows: rows that a replay begins with, which belong to no actor. They come from another replay or a
//! dataset.

use std::sync::atomic::{Ordering, fence};

use super::error::ReplayError;
use super::store::Replay;

/// Rows that are copied at once.
const AT_ONCE: u64 = 4_096;

impl Replay {
    /// Fills this empty replay with the newest rows of another one, at most `max_rows` and at most a ring, and syncs
    /// them. Returns their number.
    ///
    /// # Errors
    /// When the file cannot be synced.
    ///
    /// # Panics
    /// If this replay is not empty, or its rows have another layout.
    pub fn inherit_rows(&mut self, other: &Self, max_rows: u64) -> Result<u64, ReplayError> {
        assert_eq!(self.layout.row, other.layout.row, "rows of another layout");
        let rows = other.rows();
        let first = rows.end.saturating_sub(max_rows.min(self.layout.ring)).max(rows.start);
        self.begin_with(rows.end - first, |index| other.row(first + index))
    }

    /// Fills this empty replay with these rows, one after the other, and syncs them. Returns their number.
    ///
    /// # Errors
    /// When the file cannot be synced.
    ///
    /// # Panics
    /// If this replay is not empty, if the last row is not whole, or if there are more rows than in a ring.
    pub fn begin_with_rows(&mut self, numbers: &[f32]) -> Result<u64, ReplayError> {
        let width = self.layout.row.width();
        assert!(numbers.len().is_multiple_of(width), "rows of another layout");
        let count = (numbers.len() / width) as u64;
        assert!(count <= self.layout.ring, "more rows than a ring");
        self.begin_with(count, |index| &numbers[index as usize * width..][..width])
    }

    fn begin_with<'a>(&mut self, count: u64, row: impl Fn(u64) -> &'a [f32]) -> Result<u64, ReplayError> {
        assert_eq!(self.head(), 0, "only an empty replay begins with other rows");
        // As for a chunk: recovery after a kill must know that these places may have been written.
        self.words.store(self.offsets.write_horizon, count);
        let mut numbers = Vec::new();
        let mut next = 0;
        while next < count {
            let end = (next + AT_ONCE).min(count);
            numbers.clear();
            (next..end).for_each(|index| numbers.extend_from_slice(row(index)));
            self.ring.put(next, &numbers, |_| ());
            next = end;
        }
        // The rows are in the file before a record names them.
        fence(Ordering::Release);
        self.record.add_initial_rows(count);
        self.publish(self.record.generation() + 1);
        self.flush()?;
        Ok(count)
    }
}

#[cfg(test)]
mod tests {
    use shoal_common::transition::RowLayout;

    use super::super::{ChunkId, ReplayLayout};
    use super::*;

    fn layout(ring: u64) -> ReplayLayout {
        ReplayLayout {
            row: RowLayout::new(2, 1),
            ring,
            actors: 2,
            actor_snapshot_words: 0,
            fingerprint: 7,
        }
    }

    #[test]
    fn the_newest_rows_of_another_replay_are_the_first_of_this_one() {
        let directory = tempfile::tempdir().unwrap();
        let path = |name: &str| directory.path().join(name);
        let mut old = Replay::create(&path("old"), &layout(6)).unwrap();
        let width = layout(6).row.width();
        for sequence in 1..=5_u64 {
            let rows: Vec<f32> = (0..2 * width).map(|i| (sequence * 100) as f32 + i as f32).collect();
            let id = ChunkId {
                incarnation: 0,
                sequence,
            };
            old.append_and_commit(0, id, &rows).unwrap();
        }
        for (ring, max_rows, expected) in [(20, 20, 6), (20, 4, 4), (3, 20, 3)] {
            let name = path(&format!("{ring}-{max_rows}"));
            let mut new = Replay::create(&name, &layout(ring)).unwrap();
            assert_eq!(new.inherit_rows(&old, max_rows).unwrap(), expected);
            drop(new);
            let mut new = Replay::open(&name, &layout(ring)).unwrap();
            assert!(new.warnings().is_empty(), "{:?}", new.warnings());
            assert_eq!(new.rows(), 0..expected);
            for index in 0..expected {
                assert_eq!(new.row(index), old.row(10 - expected + index), "row {index}");
            }
            // The first chunk of an actor is still its first one.
            let id = ChunkId {
                incarnation: 0,
                sequence: 1,
            };
            new.append_and_commit(1, id, &vec![1.0; width]).unwrap();
            assert_eq!((new.head(), new.committed(1).rows), (expected + 1, 1));
        }
    }

    #[test]
    fn rows_from_elsewhere_are_the_first_ones() {
        let directory = tempfile::tempdir().unwrap();
        let name = directory.path().join("replay");
        let width = layout(6).row.width();
        let numbers: Vec<f32> = (0..5 * width).map(|number| number as f32).collect();
        let mut new = Replay::create(&name, &layout(6)).unwrap();
        assert_eq!(new.begin_with_rows(&numbers).unwrap(), 5);
        drop(new);
        let new = Replay::open(&name, &layout(6)).unwrap();
        assert!(new.warnings().is_empty(), "{:?}", new.warnings());
        let read: Vec<f32> = new.rows().flat_map(|index| new.row(index).to_vec()).collect();
        assert_eq!((new.rows(), read), (0..5, numbers));
    }
}
