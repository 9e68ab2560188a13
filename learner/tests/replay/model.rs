//! A model of what the replay should hold, and a directory for the tests.

use std::fs;
use std::path::{Path, PathBuf};

use shoal_common::commit::FileOffsets;
use shoal_common::transition::RowLayout;
use shoal_learner::replay::{ActorCommit, ChunkId, Replay, ReplayError, ReplayLayout};
use tempfile::TempDir;

pub(crate) const ACTORS: usize = 3;
/// Numbers in a row for observations and actions of one number.
pub(crate) const WIDTH: usize = 6;

pub(crate) fn layout(ring: u64) -> ReplayLayout {
    ReplayLayout {
        row: RowLayout::new(1, 1),
        ring,
        actors: ACTORS,
        actor_snapshot_words: 0,
        fingerprint: 0xF00D,
    }
}

pub(crate) fn offsets(ring: u64) -> FileOffsets {
    layout(ring).offsets().unwrap()
}

pub(crate) fn id(incarnation: u64, sequence: u64) -> ChunkId {
    ChunkId { incarnation, sequence }
}

/// A chunk whose rows identify themselves.
pub(crate) fn chunk(actor: usize, id: ChunkId, rows: u64) -> Vec<f32> {
    let row = |i| {
        [
            actor as f32,
            id.incarnation as f32,
            id.sequence as f32,
            i as f32,
            rows as f32,
            -1.0,
        ]
    };
    (0..rows).flat_map(row).collect()
}

/// What the replay should hold: every row ever committed, and each actor's last chunk.
#[derive(Clone, Default)]
pub(crate) struct Model {
    pub(crate) rows: Vec<Vec<f32>>,
    pub(crate) actors: [ActorCommit; ACTORS],
}

impl Model {
    /// The next chunk of an actor.
    pub(crate) fn next(&self, actor: usize) -> ChunkId {
        let last = self.actors[actor].last_chunk;
        id(last.incarnation, last.sequence + 1)
    }

    pub(crate) fn add(&mut self, actor: usize, id: ChunkId, numbers: &[f32]) {
        self.rows.extend(numbers.chunks(WIDTH).map(<[f32]>::to_vec));
        self.actors[actor].last_chunk = id;
        self.actors[actor].rows += (numbers.len() / WIDTH) as u64;
    }

    pub(crate) fn head(&self) -> u64 {
        self.rows.len() as u64
    }

    /// Asserts that the replay agrees with the model, with the rows in `rows()`.
    pub(crate) fn check(&self, replay: &Replay) {
        assert_eq!(replay.head(), self.head());
        for (actor, commit) in self.actors.iter().enumerate() {
            assert_eq!(replay.committed(actor), *commit);
        }
        for index in replay.rows() {
            assert_eq!(replay.row(index), self.rows[index as usize]);
        }
    }
}

pub(crate) struct Directory(pub(crate) TempDir);

impl Directory {
    pub(crate) fn new() -> Self {
        Self(TempDir::new().unwrap())
    }

    pub(crate) fn replay(&self) -> PathBuf {
        self.0.path().join("replay.rows")
    }

    pub(crate) fn names(&self) -> Vec<String> {
        fs::read_dir(&self.0)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect()
    }
}

pub(crate) fn reopen(path: &Path, bytes: &[u8], ring: u64) -> Result<Replay, ReplayError> {
    fs::write(path, bytes).unwrap();
    Replay::open(path, &layout(ring))
}

/// A closed replay into which `writes` (actor, rows) were written in order.
pub(crate) fn filled(ring: u64, writes: &[(usize, u64)]) -> (Directory, Model) {
    let directory = Directory::new();
    let mut replay = Replay::create(&directory.replay(), &layout(ring)).unwrap();
    let mut model = Model::default();
    for &(actor, rows) in writes {
        let id = model.next(actor);
        let numbers = chunk(actor, id, rows);
        replay.append_and_commit(actor, id, &numbers).unwrap();
        model.add(actor, id, &numbers);
    }
    (directory, model)
}
