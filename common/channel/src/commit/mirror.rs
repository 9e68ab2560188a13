//! A copy of a commit record on another host, in a file that its actors read as they would read the replay.

use std::fs::OpenOptions;
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use super::layout::{FileOffsets, ReplayLayout, SLOTS};
use super::record::{ActorCommit, CommitRecord};
use super::words::WritableWords;

/// Writes the copy. The file has the length and the header of the replay, but no rows, so it takes next to no space.
#[derive(Debug)]
pub struct CommitMirror {
    words: WritableWords,
    offsets: FileOffsets,
    record: CommitRecord,
}

impl CommitMirror {
    /// Opens the copy at `path`, and continues with what is in it. If it is missing, or not a whole copy of this
    /// layout, a new one is made.
    ///
    /// # Errors
    /// When the layout is impossible, or the file cannot be written.
    pub fn open(path: &Path, layout: &ReplayLayout) -> io::Result<Self> {
        let impossible = || io::Error::new(io::ErrorKind::InvalidInput, "the layout of the replay is impossible");
        let offsets = layout.offsets().ok_or_else(impossible)?;
        let earlier = match OpenOptions::new().read(true).write(true).open(path) {
            Ok(file) => Some(file),
            Err(cause) if cause.kind() == io::ErrorKind::NotFound => None,
            Err(cause) => return Err(cause),
        };
        if let Some(file) = earlier
            && file.metadata()?.len() == offsets.end as u64
        {
            let words = WritableWords::map(&file, offsets.header)?;
            let same = ReplayLayout::read(words.read()).is_ok_and(|found| found == *layout);
            let slot = offsets.slots[(words.read().load(offsets.published) % 2) as usize];
            if let Some(record) = CommitRecord::load(words.read(), slot, layout).filter(|_| same) {
                return Ok(Self { words, offsets, record });
            }
        }
        // Made under another name, so that an actor never finds half a file.
        let temporary = path.with_extension("new");
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create(true)
            .truncate(true)
            .mode(0o600)
            .open(&temporary)?;
        file.set_len(offsets.end as u64)?;
        let mut words = WritableWords::map(&file, offsets.header)?;
        for (i, word) in layout.preamble().into_iter().enumerate() {
            words.store(i * size_of::<u64>(), word);
        }
        let mut record = CommitRecord::empty(layout);
        record.set_generation(1);
        for slot in offsets.slots.iter().take(SLOTS) {
            record.store(&mut words, *slot, |_| ());
        }
        words.store(offsets.published, record.generation());
        std::fs::rename(&temporary, path)?;
        Ok(Self { words, offsets, record })
    }

    /// What the copy has of an actor.
    ///
    /// # Panics
    /// If the layout has no such actor.
    pub fn actor(&self, actor: usize) -> ActorCommit {
        self.record.actor(actor)
    }

    /// Publishes what is committed of some actors, with their snapshots, and how many rows the replay has. Readers see
    /// all of it or nothing. Actors that the layout does not have are ignored, and so are snapshots of another length.
    pub fn publish<'a>(&mut self, rows: u64, actors: impl IntoIterator<Item = (u32, ActorCommit, &'a [u64])>) {
        let count = self.record.actors();
        let mut rows = rows;
        for (actor, commit, snapshot) in actors {
            let actor = actor as usize;
            if actor < count {
                self.record.set_actor(actor, commit);
                if self.record.actor_snapshot(actor).len() == snapshot.len() {
                    self.record.set_actor_snapshot(actor, snapshot);
                }
                rows = rows.max(commit.rows);
            }
        }
        self.record.set_head(rows);
        let generation = self.record.generation() + 1;
        self.record.set_generation(generation);
        let slot = self.offsets.slots[(generation % 2) as usize];
        self.record.store(&mut self.words, slot, |_| ());
        self.words.store(self.offsets.published, generation);
    }
}

#[cfg(test)]
mod tests {
    use shoal_base::transition::RowLayout;

    use super::super::reader::{CommitReader, OpenError};
    use super::super::record::ChunkId;
    use super::*;

    fn layout() -> ReplayLayout {
        ReplayLayout {
            row: RowLayout::new(3, 1),
            ring: 1_000_000,
            actors: 4,
            actor_snapshot_words: 2,
            fingerprint: 17,
        }
    }

    fn commit(incarnation: u64, sequence: u64, rows: u64) -> ActorCommit {
        ActorCommit {
            last_chunk: ChunkId { incarnation, sequence },
            rows,
        }
    }

    #[test]
    fn actors_read_a_mirror_as_they_read_a_replay_and_it_outlives_its_writer() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("replay.bin");
        let mut mirror = CommitMirror::open(&path, &layout()).unwrap();
        let reader = CommitReader::open(&path).unwrap();
        assert_eq!((reader.rows(), reader.committed(2)), (0, ChunkId::default()));
        mirror.publish(640, [(2, commit(7, 5, 320), &[3, 4][..]), (9, commit(1, 1, 1), &[])]);
        assert_eq!((reader.rows(), reader.actor(2)), (640, commit(7, 5, 320)));
        assert!(reader.snapshot().is_some());
        assert_eq!(reader.actor_snapshot(2), [3, 4]);
        drop(mirror);
        let mut mirror = CommitMirror::open(&path, &layout()).unwrap();
        assert_eq!(mirror.actor(2), commit(7, 5, 320));
        mirror.publish(600, [(2, commit(7, 4, 280), &[][..])]);
        assert_eq!((reader.rows(), reader.actor(2)), (600, commit(7, 4, 280)));
        use std::os::unix::fs::MetadataExt;
        let taken = std::fs::metadata(&path).unwrap().blocks() * 512;
        assert!(taken < 1 << 20, "the file takes {taken} bytes");
    }

    #[test]
    fn nobody_sees_half_a_file() {
        for _ in 0..200 {
            let directory = tempfile::tempdir().unwrap();
            let path = directory.path().join("replay.bin");
            std::thread::scope(|scope| {
                scope.spawn(|| {
                    while let Err(error) = CommitReader::open(&path) {
                        assert!(matches!(error, OpenError::NotYet { .. }), "{error}");
                    }
                });
                CommitMirror::open(&path, &layout()).unwrap();
            });
        }
    }

    #[test]
    fn a_file_of_another_layout_is_made_anew() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("replay.bin");
        CommitMirror::open(&path, &layout())
            .unwrap()
            .publish(9, [(0, commit(1, 1, 9), &[][..])]);
        let other = ReplayLayout {
            fingerprint: 18,
            ..layout()
        };
        let mirror = CommitMirror::open(&path, &other).unwrap();
        assert_eq!(mirror.actor(0), ActorCommit::default());
        assert_eq!(CommitReader::open(&path).unwrap().layout(), &other);
    }
}
