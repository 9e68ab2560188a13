//! Files whose header was written by nobody who means well, with every checksum right.

use std::fs;

use proptest::prelude::*;
use shoal_common::commit::{CommitReader, OpenError};
use shoal_learner::replay::{Appended, ChunkMark, Replay, ReplayError};

use crate::model::{ACTORS, chunk, filled, layout, mark, places, reopen};

const RING: u64 = 40;
/// Words of a record: generation, head, tail, and three an actor.
const WORDS: usize = 3 + 3 * ACTORS;

fn extreme() -> impl Strategy<Value = u64> {
    prop_oneof![
        3 => 0..90_u64,
        1 => (0..64_u32).prop_map(|bit| 1 << bit),
        // Around the greatest that is believed.
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

/// Opened by a learner, written to and opened again; looked at by an actor each time.
fn used(path: &std::path::Path, image: &[u8]) -> Result<(), TestCaseError> {
    fs::write(path, image).unwrap();
    for life in 0..3 {
        let look = || match CommitReader::open(path) {
            Ok(reader) => {
                reader.rows();
                (0..ACTORS).for_each(|actor| assert_eq!(reader.actor(actor).mark, reader.committed(actor)));
                assert!(reader.snapshot().is_some());
            }
            Err(OpenError::NotYet { .. } | OpenError::Refused { .. }) => {}
            Err(error) => panic!("{error}"),
        };
        look();
        let before = fs::read(path).unwrap();
        let mut replay = match Replay::open(path, &layout(RING)) {
            Ok(replay) => replay,
            Err(ReplayError::Refused { .. }) => {
                prop_assert_eq!(fs::read(path).unwrap(), before);
                return Ok(());
            }
            Err(error) => return Err(TestCaseError::fail(error.to_string())),
        };
        look();
        let rows = replay.rows();
        prop_assert!(rows.end - rows.start <= RING);
        rows.clone().for_each(|index| drop(replay.row(index).to_vec()));
        for (head, capacity) in [(0, 1), (rows.end, RING), (u64::MAX, u64::MAX), (rows.start, 0)] {
            let window = replay.window(head, capacity);
            prop_assert!(window.is_empty() || rows.start <= window.start && window.end <= rows.end);
        }
        for actor in 0..ACTORS {
            let ChunkMark { incarnation, sequence } = replay.committed(actor).mark;
            let next = mark(incarnation, sequence.saturating_add(1));
            let appended = replay
                .append_and_commit(actor, next, &chunk(actor, mark(life, 1), 30))
                .unwrap();
            prop_assert_eq!(appended == Appended::Duplicate, sequence == u64::MAX);
        }
        replay.flush().unwrap();
        look();
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    /// Any words of a whole file's records, selector and reach replaced; sealed again or not.
    #[test]
    fn records_that_lie_are_used_or_refused(
        writes in prop::collection::vec((0..ACTORS, 1_u64..20), 0..8),
        lies in prop::collection::vec((0..4_usize, 0..WORDS, extreme()), 0..10),
        sealed in prop::array::uniform4(prop::bool::weighted(0.8)),
        selector in prop::option::of(extreme()),
        reach in prop::option::of(extreme()),
    ) {
        let (directory, _) = filled(RING, &writes);
        let mut image = fs::read(directory.replay()).unwrap();
        for (slot, word, lie) in lies {
            put(&mut image, places(RING).slots[slot] + 8 * (1 + word), lie);
        }
        for (slot, sealed) in places(RING).slots.into_iter().zip(sealed) {
            if sealed {
                seal(&mut image, slot);
            }
        }
        for (at, lie) in [(places(RING).selector, selector), (places(RING).reach, reach)] {
            if let Some(lie) = lie {
                put(&mut image, at, lie);
            }
        }
        used(&directory.replay(), &image)?;
    }

    /// An identity with any numbers and a checksum that fits is refused unless it is the run's own.
    #[test]
    fn an_identity_that_lies_is_refused(lies in prop::collection::vec((2..9_usize, extreme()), 1..4)) {
        let (directory, _) = filled(RING, &[(0, 10)]);
        let mut image = fs::read(directory.replay()).unwrap();
        let own = image[..72].to_vec();
        for (word, lie) in lies {
            put(&mut image, 8 * word, lie);
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
