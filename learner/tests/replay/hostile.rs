//! Files with hostile headers whose checksums are right.

use std::fs;

use proptest::prelude::*;
use shoal_common::commit::{CommitReader, OpenError};
use shoal_learner::replay::{Appended, ChunkId, Replay, ReplayError};

use crate::model::{ACTORS, chunk, filled, id, layout, offsets, reopen};

const RING: u64 = 40;
/// Words of a record: generation, head, tail, and three per actor.
const WORDS: usize = 3 + 3 * ACTORS;

fn extreme() -> impl Strategy<Value = u64> {
    prop_oneof![
        3 => 0..90_u64,
        1 => (0..64_u32).prop_map(|bit| 1 << bit),
        // Around the greatest value that is accepted.
        2 => (0..60_u64).prop_map(|below| (1 << 60) - 1 - below),
        1 => (0..40_u64).prop_map(|below| u64::MAX - below),
        1 => any::<u64>(),
    ]
}

fn put(image: &mut [u8], at: usize, word: u64) {
    image[at..at + 8].copy_from_slice(&word.to_le_bytes());
}

fn seal(image: &mut [u8], slot: usize) {
    let seal = 1 << 32 | u64::from(crc32fast::hash(&image[slot + 8..][..8 * WORDS]));
    put(image, slot, seal);
}

/// Opens the file as a learner, writes to it and opens it again. Each time, reads it as an actor.
fn use_file(path: &std::path::Path, image: &[u8]) -> Result<(), TestCaseError> {
    fs::write(path, image).unwrap();
    for life in 0..3 {
        let read_as_actor = || match CommitReader::open(path) {
            Ok(reader) => {
                reader.rows();
                (0..ACTORS).for_each(|actor| assert_eq!(reader.actor(actor).last_chunk, reader.committed(actor)));
                assert!(reader.snapshot().is_some());
            }
            Err(OpenError::NotYet { .. } | OpenError::Refused { .. }) => {}
            Err(error) => panic!("{error}"),
        };
        read_as_actor();
        let before = fs::read(path).unwrap();
        let mut replay = match Replay::open(path, &layout(RING)) {
            Ok(replay) => replay,
            Err(ReplayError::Refused { .. }) => {
                prop_assert_eq!(fs::read(path).unwrap(), before);
                return Ok(());
            }
            Err(error) => return Err(TestCaseError::fail(error.to_string())),
        };
        read_as_actor();
        let rows = replay.rows();
        prop_assert!(rows.end - rows.start <= RING);
        rows.clone().for_each(|index| drop(replay.row(index).to_vec()));
        for (head, capacity) in [(0, 1), (rows.end, RING), (u64::MAX, u64::MAX), (rows.start, 0)] {
            let range = replay.sampling_range(head, capacity);
            prop_assert!(range.is_empty() || rows.start <= range.start && range.end <= rows.end);
        }
        for actor in 0..ACTORS {
            let ChunkId { incarnation, sequence } = replay.committed(actor).last_chunk;
            let next = id(incarnation, sequence.saturating_add(1));
            let appended = replay
                .append_and_commit(actor, next, &chunk(actor, id(life, 1), 30))
                .unwrap();
            prop_assert_eq!(appended == Appended::Duplicate, sequence == u64::MAX);
        }
        replay.flush().unwrap();
        read_as_actor();
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    /// Replaces any words of a whole file's records, its published generation and its write horizon, with right or
    /// wrong checksums.
    #[test]
    fn hostile_records_are_used_or_refused(
        writes in prop::collection::vec((0..ACTORS, 1_u64..20), 0..8),
        changes in prop::collection::vec((0..4_usize, 0..WORDS, extreme()), 0..10),
        sealed in prop::array::uniform4(prop::bool::weighted(0.8)),
        published in prop::option::of(extreme()),
        write_horizon in prop::option::of(extreme()),
    ) {
        let (directory, _) = filled(RING, &writes);
        let mut image = fs::read(directory.replay()).unwrap();
        for (slot, word, value) in changes {
            put(&mut image, offsets(RING).slots[slot] + 8 * (1 + word), value);
        }
        for (slot, sealed) in offsets(RING).slots.into_iter().zip(sealed) {
            if sealed {
                seal(&mut image, slot);
            }
        }
        for (at, value) in [(offsets(RING).published, published), (offsets(RING).write_horizon, write_horizon)] {
            if let Some(value) = value {
                put(&mut image, at, value);
            }
        }
        use_file(&directory.replay(), &image)?;
    }

    /// A preamble with any numbers and a right checksum is refused unless it is the run's own.
    #[test]
    fn a_hostile_identity_is_refused(changes in prop::collection::vec((2..9_usize, extreme()), 1..4)) {
        let (directory, _) = filled(RING, &[(0, 10)]);
        let mut image = fs::read(directory.replay()).unwrap();
        let own = image[..72].to_vec();
        for (word, value) in changes {
            put(&mut image, 8 * word, value);
        }
        let checksum = crc32fast::hash(&image[..72]);
        put(&mut image, 72, checksum.into());
        let is_own = image[..72] == own;
        let opened = reopen(&directory.replay(), &image, RING);
        if is_own {
            prop_assert!(opened.is_ok());
        } else {
            prop_assert!(matches!(opened, Err(ReplayError::Refused { .. })), "{:?}", opened);
            prop_assert_eq!(fs::read(directory.replay()).unwrap(), image);
        }
    }
}
