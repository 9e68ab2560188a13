//! Which chunks are committed, and which rows can be read.

use shoal_learner::replay::{Appended, ChunkError, Replay};

use crate::model::{chunk, filled, id, layout};

#[test]
fn a_chunk_is_committed_once_and_not_from_an_old_incarnation() {
    let (directory, mut model) = filled(100, &[(0, 3), (1, 2), (0, 4)]);
    let mut replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    let mut append = |id| replay.append_and_commit(0, id, &chunk(0, id, 2)).unwrap();
    assert_eq!(append(id(0, 1)), Appended::Duplicate);
    assert_eq!(append(id(0, 2)), Appended::Duplicate);
    assert_eq!(
        append(id(1, 2)),
        Appended::Accepted,
        "the first chunk of an incarnation"
    );
    assert_eq!(append(id(0, 3)), Appended::Duplicate);
    assert_eq!(append(id(1, 2)), Appended::Duplicate);
    assert_eq!(append(id(1, 3)), Appended::Accepted);
    for id in [id(1, 2), id(1, 3)] {
        model.add(0, id, &chunk(0, id, 2));
    }
    model.check(&replay);
}

#[test]
fn a_chunk_that_is_not_the_next_one_is_refused_and_nothing_is_written() {
    let (directory, model) = filled(100, &[(0, 3), (1, 2), (0, 4)]);
    let mut replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    let last = u64::MAX;
    // The last chunk of actor 0 was chunk 2 of incarnation 0.
    for (incarnation, sequence) in [
        (0, 4),
        (0, last),
        (1, 1),
        (1, 3),
        (7, 9),
        (last, 2),
        (last, 3),
        (last, last),
    ] {
        let id = id(incarnation, sequence);
        let refused = replay.append_and_commit(0, id, &chunk(0, id, 2)).unwrap_err();
        let committed = replay.committed(0).last_chunk;
        assert_eq!(
            refused,
            ChunkError::OutOfOrder {
                actor: 0,
                id,
                committed
            }
        );
    }
    model.check(&replay);
}

#[test]
fn an_invalid_chunk_is_refused_and_nothing_is_written() {
    let (directory, model) = filled(10, &[(0, 10)]);
    let mut replay = Replay::open(&directory.replay(), &layout(10)).unwrap();
    let mut append = |actor, rows: &[f32]| replay.append_and_commit(actor, id(0, 2), rows).unwrap_err();
    assert_eq!(append(3, &[0.0; 6]), ChunkError::Actor { actor: 3, actors: 3 });
    assert_eq!(
        append(0, &[0.0; 7]),
        ChunkError::Ragged {
            actor: 0,
            numbers: 7,
            width: 6
        }
    );
    assert_eq!(
        append(0, &[0.0; 66]),
        ChunkError::TooLong {
            actor: 0,
            rows: 11,
            ring: 10
        }
    );
    model.check(&replay);
    assert_eq!(replay.rows(), 0..10);
}

#[test]
fn a_chunk_that_was_filled_and_dropped_is_not_committed_and_the_rows_it_overwrote_are_not_readable() {
    let (directory, model) = filled(10, &[(0, 10)]);
    let mut replay = Replay::open(&directory.replay(), &layout(10)).unwrap();
    drop(
        replay
            .reserve(1, id(0, 1))
            .unwrap()
            .unwrap()
            .fill(&chunk(1, id(0, 1), 3))
            .unwrap(),
    );
    model.check(&replay);
    assert_eq!(replay.rows(), 3..10);
    drop(replay);
    let replay = Replay::open(&directory.replay(), &layout(10)).unwrap();
    model.check(&replay);
    assert_eq!((replay.rows(), replay.warnings()), (3..10, &[] as &[String]));
}

#[test]
fn a_sampling_range_is_the_newest_rows_before_its_end() {
    let (directory, _) = filled(100, &[(0, 60), (1, 60)]);
    let replay = Replay::open(&directory.replay(), &layout(100)).unwrap();
    assert_eq!(replay.rows(), 20..120);
    assert_eq!(replay.sampling_range(120, 50), 70..120);
    assert_eq!(replay.sampling_range(90, 50), 40..90);
    assert_eq!(replay.sampling_range(60, 50), 20..60);
    assert_eq!(replay.sampling_range(200, 50), 70..120);
    assert!(replay.sampling_range(10, 50).is_empty());
}
