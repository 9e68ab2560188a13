//! Files that are not checkpoints, and hostile ones whose checksums are right.

use std::fs;
use std::io::Write;
use std::path::Path;

use bincode::config;
use proptest::prelude::*;
use proptest::sample::Index;
use rustix::process::{Resource, Rlimit, setrlimit};
use shoal_common::durable::{self, FileKind};
use shoal_learner::process::checkpoint::{CheckpointError, Checkpoints, Counters, LoadedCheckpoint};
use tempfile::TempDir;

const NAMES: [&str; 2] = ["latest.ckpt", "previous.ckpt"];

/// The header as it is written: fingerprint, counters, arrays.
type Header = (u64, (u64, u64, u64, u64), Vec<(String, u64)>);

/// Limits memory, so that allocating by a hostile length fails.
fn limit_memory() {
    let limit = Some(1 << 30);
    setrlimit(
        Resource::As,
        Rlimit {
            current: limit,
            maximum: limit,
        },
    )
    .unwrap();
}

fn save(directory: &Path, updates: u64) {
    let counters = Counters {
        updates,
        rows: 2 * updates,
        episodes: 0,
        policy_version: 1,
    };
    let arrays: [(&str, &[f32]); 3] = [("actor", &[1.0, 2.0]), ("empty", &[]), ("critic", &[updates as f32])];
    Checkpoints::new(directory, 7).save(&counters, &arrays).unwrap();
}

/// Loads, and asserts that the files have not changed.
fn load(directory: &Path) -> Result<Option<LoadedCheckpoint>, CheckpointError> {
    let read = || NAMES.map(|name| fs::read(directory.join(name)).ok());
    let before = read();
    let loaded = Checkpoints::new(directory, 7).load_newest();
    assert_eq!(read(), before);
    if let Err(error) = &loaded {
        assert!(!error.to_string().contains('\n'), "{error}");
    }
    loaded
}

fn extreme() -> impl Strategy<Value = u64> {
    prop_oneof![
        0..5_u64,
        (0..64_u32).prop_map(|bit| 1 << bit),
        (0..40_u64).prop_map(|below| u64::MAX - below),
        any::<u64>(),
    ]
}

#[derive(Clone, Debug)]
enum Damage {
    Flip(Index, u8),
    Cut(Index),
    Insert(Index, Vec<u8>),
}

fn damage() -> impl Strategy<Value = Damage> {
    prop_oneof![
        (any::<Index>(), 1_u8..).prop_map(|(at, bits)| Damage::Flip(at, bits)),
        any::<Index>().prop_map(Damage::Cut),
        (any::<Index>(), prop::collection::vec(any::<u8>(), 1..9)).prop_map(|(at, new)| Damage::Insert(at, new)),
    ]
}

fn damaged(mut bytes: Vec<u8>, damage: Vec<Damage>) -> Vec<u8> {
    for damage in damage {
        // One place more than there are bytes, for the end.
        let place = |at: Index| at.index(bytes.len() + 1);
        match damage {
            Damage::Flip(at, bits) => {
                let at = place(at);
                bytes.iter_mut().skip(at).take(1).for_each(|byte| *byte ^= bits);
            }
            Damage::Cut(at) => bytes.truncate(place(at)),
            Damage::Insert(at, new) => {
                let at = place(at);
                bytes.splice(at..at, new);
            }
        }
    }
    bytes
}

fn sealed(path: &Path, body: &[u8]) {
    const KIND: FileKind = FileKind {
        magic: *b"SHOALCKP",
        version: 2,
        name: "a checkpoint",
    };
    durable::write_atomically(path, |file| durable::seal(KIND, file, |to| to.write_all(body))).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 150, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn arbitrary_bytes_in_either_file_are_refused(
        bytes in prop::array::uniform2(prop::option::of(prop::collection::vec(any::<u8>(), 0..200))),
    ) {
        let directory = TempDir::new().unwrap();
        for (name, bytes) in NAMES.into_iter().zip(&bytes) {
            bytes.iter().for_each(|bytes| fs::write(directory.path().join(name), bytes).unwrap());
        }
        match load(directory.path()) {
            Ok(loaded) => prop_assert!(loaded.is_none() && bytes == [None, None]),
            Err(error) => prop_assert!(matches!(error, CheckpointError::AllDamaged { .. }), "{}", error),
        }
    }

    /// Whatever is loaded was saved.
    #[test]
    fn damaged_checkpoints_fall_back_or_are_refused(
        latest in prop::collection::vec(damage(), 0..4),
        previous in prop::collection::vec(damage(), 0..3),
    ) {
        let directory = TempDir::new().unwrap();
        save(directory.path(), 1);
        save(directory.path(), 2);
        let mut whole = vec![];
        for ((name, damage), updates) in NAMES.into_iter().zip([latest, previous]).zip([2, 1]) {
            let path = directory.path().join(name);
            let before = fs::read(&path).unwrap();
            let after = damaged(before.clone(), damage);
            fs::write(path, &after).unwrap();
            whole.extend((before == after).then_some(updates));
        }
        match (load(directory.path()), whole.first()) {
            (Ok(Some(loaded)), Some(&updates)) => {
                prop_assert_eq!(loaded.checkpoint.counters.updates, updates);
                prop_assert_eq!(&loaded.checkpoint.arrays[2].1, &[updates as f32]);
                prop_assert_eq!(loaded.warnings.is_empty(), updates == 2);
            }
            (Err(CheckpointError::AllDamaged { .. }), None) => {}
            (loaded, whole) => prop_assert!(false, "{:?} of {:?}", loaded, whole),
        }
    }

    /// The checksum is right.
    #[test]
    fn a_body_of_arbitrary_bytes_is_refused(body in prop::collection::vec(any::<u8>(), 0..200), lengths in prop::array::uniform3(extreme())) {
        limit_memory();
        let directory = TempDir::new().unwrap();
        save(directory.path(), 1);
        let path = directory.path().join("latest.ckpt");
        // The bytes alone, and the bytes after hostile values for the number of arrays and the length of the first
        // name.
        let [arrays, name, numbers] = lengths;
        let mut claims = [7, 1, 2, 3, 4, arrays, name].map(u64::to_le_bytes).concat();
        claims.extend(&body);
        claims.extend(numbers.to_le_bytes());
        for body in [&body, &claims] {
            sealed(&path, body);
            match load(directory.path()) {
                Err(CheckpointError::AllDamaged { .. } | CheckpointError::Refused { .. }) => {}
                // With no arrays, there is nothing after their number.
                Ok(Some(_)) => prop_assert!(arrays == 0),
                other => prop_assert!(false, "{:?}", other),
            }
        }
    }

    #[test]
    fn a_hostile_header_is_refused(
        fingerprint in prop_oneof![Just(7), extreme()],
        counters in (extreme(), extreme(), extreme(), extreme()),
        arrays in prop::collection::vec(("[a-z]{0,5}", prop_oneof![0..9_u64, extreme()]), 0..4),
        right in any::<bool>(),
        odd in 0..4_usize,
        numbers in 0..20_usize,
    ) {
        limit_memory();
        let claimed = arrays.iter().try_fold(0_u64, |sum, (_, length)| sum.checked_add(*length));
        let numbers = match claimed {
            Some(claimed) if right && claimed < 100 => claimed as usize,
            _ => numbers,
        };
        let header: Header = (fingerprint, counters, arrays);
        let encoding = config::standard().with_fixed_int_encoding();
        let mut body = bincode::serde::encode_to_vec(&header, encoding).unwrap();
        body.resize(body.len() + 4 * numbers + odd, 0x3f);
        let directory = TempDir::new().unwrap();
        sealed(&directory.path().join("latest.ckpt"), &body);

        let fits = claimed == Some(numbers as u64) && odd == 0;
        let possible = counters.0.max(counters.1).max(counters.2).max(counters.3) < 1 << 60;
        match load(directory.path()) {
            Ok(Some(loaded)) => {
                prop_assert!(fits && possible && fingerprint == 7);
                let counters = loaded.checkpoint.counters;
                // A learner continues to count from there.
                prop_assert!([counters.updates, counters.rows, counters.episodes, counters.policy_version].iter().all(|n| *n < 1 << 60));
            }
            Err(CheckpointError::Refused { .. }) => prop_assert!(fingerprint != 7),
            Err(CheckpointError::AllDamaged { .. }) => prop_assert!(!(fits && possible)),
            other => prop_assert!(false, "{:?}", other),
        }
    }
}
