//! The chunks that test actors send. Every row contains the id of its chunk and its position in it.

use std::path::Path;

use shoal_common::channel::transitions::Chunk;
use shoal_common::transition::{ChunkLayout, RowLayout, Transition};
use shoal_learner::replay::{Replay, ReplayLayout};

pub(crate) const WINDOW: u32 = 8;
pub(crate) const ROWS: usize = 4;
const RING: u64 = 1 << 16;

/// A chunk: actor, incarnation, sequence.
pub(crate) type Id = (u32, u64, u64);

fn row_layout() -> RowLayout {
    RowLayout::new(2, 1)
}

pub(crate) fn chunk_layout() -> ChunkLayout {
    ChunkLayout {
        row: row_layout(),
        rows: ROWS,
        actor_snapshot_words: 0,
    }
}

pub(crate) fn replay_layout(actors: u32) -> ReplayLayout {
    ReplayLayout {
        row: row_layout(),
        ring: RING,
        actors: actors as usize,
        actor_snapshot_words: 0,
        fingerprint: 1,
    }
}

/// Fills the first rows of a chunk.
pub(crate) fn fill(chunk: &mut Chunk, (actor, incarnation, sequence): Id, rows: usize) {
    for row in 0..rows {
        let s = [actor as f32, incarnation as f32];
        let s_next = [row as f32, -1.0];
        let [a, r] = [sequence as f32, 0.5];
        chunk.push(&Transition {
            s: &s,
            a: &[a],
            r,
            discount: 1.0,
            s_next: &s_next,
            last: row + 1 == ROWS,
        });
    }
}

/// The chunks of a replay in the order of their commits. No process may be writing it.
pub(crate) fn committed(path: &Path, actors: u32) -> Vec<Id> {
    let replay = Replay::open(path, &replay_layout(actors)).unwrap();
    assert_eq!(replay.warnings(), [] as [String; 0]);
    assert_eq!(replay.rows().start, 0, "the ring is large enough for the whole test");
    let rows: Vec<_> = replay
        .rows()
        .map(|index| row_layout().read(replay.row(index)))
        .collect();
    assert_eq!(rows.len() % ROWS, 0, "every chunk is whole");
    let id = |chunk: &[Transition<'_>]| {
        for (i, row) in chunk.iter().enumerate() {
            assert_eq!(
                (row.s, row.a),
                (chunk[0].s, chunk[0].a),
                "rows of a chunk stay together"
            );
            assert_eq!((row.s_next, row.last), (&[i as f32, -1.0][..], i + 1 == ROWS));
        }
        (chunk[0].s[0] as u32, chunk[0].s[1] as u64, chunk[0].a[0] as u64)
    };
    rows.chunks_exact(ROWS).map(id).collect()
}

/// The ids of chunks 1 to `last` of an actor's incarnation.
pub(crate) fn chunk_ids(actor: u32, incarnation: u64, last: u64) -> Vec<Id> {
    (1..=last).map(|sequence| (actor, incarnation, sequence)).collect()
}
