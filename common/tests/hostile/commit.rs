//! Invalid headers of the replay, for its readers.

use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use proptest::prelude::*;
use shoal_common::commit::{CommitReader, FileOffsets, OpenError, ReplayLayout};
use shoal_common::transition::RowLayout;
use tempfile::TempDir;

use crate::bytes::{Damage, damage, extreme};

const ACTORS: usize = 3;
const WORDS: usize = 3 + 3 * ACTORS;

fn layout() -> ReplayLayout {
    ReplayLayout {
        row: RowLayout::new(1, 1),
        ring: 10,
        actors: ACTORS,
        actor_snapshot_words: 0,
        fingerprint: 5,
    }
}

fn offsets() -> FileOffsets {
    layout().offsets().unwrap()
}

fn word(bytes: &mut [u8], at: usize, word: u64) {
    bytes[at..at + 8].copy_from_slice(&word.to_le_bytes());
}

/// Writes these words into a slot, with a matching seal.
fn sealed(bytes: &mut [u8], slot: usize, words: &[u64]) {
    let record: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    word(bytes, slot, 1 << 32 | u64::from(crc32fast::hash(&record)));
    bytes[slot + 8..][..record.len()].copy_from_slice(&record);
}

/// A replay of six rows, all of actor 0.
fn file() -> Vec<u8> {
    let mut bytes = vec![0; offsets().end];
    for (i, of_preamble) in layout().preamble().into_iter().enumerate() {
        word(&mut bytes, 8 * i, of_preamble);
    }
    let mut words = [0; WORDS];
    words[..6].copy_from_slice(&[2, 6, 0, 1, 3, 6]);
    sealed(&mut bytes, offsets().slots[0], &words);
    word(&mut bytes, offsets().published, 2);
    bytes
}

fn written(bytes: &[u8]) -> (TempDir, PathBuf) {
    let directory = TempDir::new().unwrap();
    let path = directory.path().join("replay.bin");
    fs::write(&path, bytes).unwrap();
    (directory, path)
}

/// Opens the file and reads everything. Returns `None` if it is refused or not ready; the file must not change.
fn read_all(path: &Path) -> Option<CommitReader> {
    let before = fs::read(path).unwrap();
    let reader = match CommitReader::open(path) {
        Ok(reader) => Some(reader),
        Err(OpenError::NotYet { .. } | OpenError::Refused { .. }) => None,
        Err(error) => panic!("{error}"),
    };
    if let Some(reader) = &reader {
        reader.rows();
        for actor in 0..reader.layout().actors {
            assert_eq!(reader.actor(actor).last_chunk, reader.committed(actor));
        }
        let record = reader.snapshot().unwrap();
        assert!(record.tail() <= record.head() && record.actors() == reader.layout().actors);
    }
    assert_eq!(fs::read(path).unwrap(), before);
    reader
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_damaged_header_is_read_or_refused(damage in prop::collection::vec(damage(), 1..4), in_use in any::<bool>()) {
        let mut bytes = file();
        for damage in damage {
            match damage {
                // Only bytes that are used.
                Damage::Flip(at, bits) if in_use => {
                    let slot = offsets().slots[0];
                    let used: Vec<usize> = (0..72).chain(4096..4112).chain(slot..slot + 8 * (WORDS + 1)).collect();
                    bytes[*at.get(&used)] ^= bits;
                }
                damage => damage.apply(&mut bytes),
            }
            if bytes.len() < offsets().end {
                break;
            }
        }
        let (_directory, path) = written(&bytes);
        if let Some(reader) = read_all(&path) {
            prop_assert_eq!(reader.layout(), &layout());
            prop_assert_eq!(reader.rows(), 6);
        }
    }

    /// With matching seals.
    #[test]
    fn records_with_false_numbers_are_read_or_refused(
        changes in prop::collection::vec((0..4_usize, 0..WORDS, extreme()), 1..12),
        published in prop_oneof![Just(2), extreme()],
        write_horizon in extreme(),
    ) {
        let mut bytes = file();
        let mut records = [[0; WORDS]; 4];
        records.iter_mut().for_each(|words| words[..6].copy_from_slice(&[2, 6, 0, 1, 3, 6]));
        for (slot, which, value) in changes {
            records[slot][which] = value;
        }
        for (slot, words) in offsets().slots.into_iter().zip(records) {
            sealed(&mut bytes, slot, &words);
        }
        word(&mut bytes, offsets().published, published);
        word(&mut bytes, offsets().write_horizon, write_horizon);
        let (_directory, path) = written(&bytes);
        read_all(&path);
    }

    /// With a matching checksum, and with the length that the header requires if a file can have it.
    #[test]
    fn an_identity_with_false_numbers_is_refused(
        words in prop::array::uniform5(extreme()),
        width in any::<bool>(),
        sizes in any::<bool>(),
    ) {
        let [observation, action, row, ring, actors] = words;
        let mut preamble = layout().preamble();
        preamble.truncate(8);
        preamble[2..7].copy_from_slice(&[observation, action, row, ring, actors]);
        if width {
            preamble[4] = observation.wrapping_mul(2).wrapping_add(action).wrapping_add(3);
        }
        let bytes: Vec<u8> = preamble.iter().flat_map(|word| word.to_le_bytes()).collect();
        let (_directory, path) = written(&bytes);
        let file = File::options().write(true).open(&path).unwrap();
        file.write_all_at(&u64::from(crc32fast::hash(&bytes)).to_le_bytes(), 64).unwrap();
        let claimed = ReplayLayout {
            row: RowLayout::new(observation as u32 as usize, action as u32 as usize),
            ring,
            actors: actors as usize,
            actor_snapshot_words: 0,
            fingerprint: 5,
        };
        // The file is sparse, so it takes no space.
        let length = claimed.offsets().map_or(1 << 20, |offsets| offsets.end as u64);
        if file.set_len(if sizes { length } else { 1 << 20 }).is_ok() {
            match CommitReader::open(&path) {
                Err(OpenError::NotYet { .. } | OpenError::Refused { .. }) => {}
                // The header is too large to be mapped.
                Err(OpenError::Io { .. }) => prop_assert!(length > 1 << 40),
                Ok(reader) => panic!("nothing was committed: {reader:?}"),
            }
        }
    }
}

#[test]
fn an_undamaged_file_is_read() {
    let (_directory, path) = written(&file());
    let reader = read_all(&path).unwrap();
    assert_eq!(
        (reader.rows(), reader.actor(0).rows, reader.committed(0).sequence),
        (6, 6, 3)
    );
}

#[test]
fn a_record_in_which_an_actor_has_more_rows_than_all_is_damaged() {
    let mut bytes = file();
    let mut words = [0; WORDS];
    words[..6].copy_from_slice(&[2, 6, 0, 1, 3, u64::MAX]);
    sealed(&mut bytes, offsets().slots[0], &words);
    let (_directory, path) = written(&bytes);
    assert!(read_all(&path).is_none());
}

#[test]
fn a_file_for_too_many_actors_is_refused() {
    let many = ReplayLayout {
        actors: u32::MAX as usize,
        actor_snapshot_words: 0,
        ..layout()
    };
    let bytes: Vec<u8> = many.preamble().iter().flat_map(|word| word.to_le_bytes()).collect();
    let (_directory, path) = written(&bytes);
    // The length that such a layout would need: a sparse file of half a terabyte.
    let slot = (u64::from(u32::MAX) * 3 + 4) * 8;
    let length = 8192 + 4 * slot.next_multiple_of(4096) + 8192;
    File::options()
        .write(true)
        .open(&path)
        .unwrap()
        .set_len(length)
        .unwrap();
    let error = CommitReader::open(&path).unwrap_err();
    assert!(
        matches!(error, OpenError::Refused { .. }) && error.to_string().contains("impossible size"),
        "{error}"
    );
}
