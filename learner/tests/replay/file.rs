//! Which files are created, and which are refused.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::time::Duration;

use proptest::prelude::*;
use shoal_common::commit::{CommitReader, OpenError};
use shoal_common::file_lock;
use shoal_common::transition::RowLayout;
use shoal_learner::replay::{Replay, ReplayError, ReplayLayout};

use crate::model::{Directory, filled, layout, offsets, reopen};

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_file_of_any_bytes_is_refused(bytes in prop::collection::vec(any::<u8>(), 0..9000), magic in any::<bool>()) {
        let directory = Directory::new();
        let mut bytes = bytes;
        if magic && bytes.len() >= 16 {
            bytes[..8].copy_from_slice(b"SHOALRPL");
            bytes[8..16].copy_from_slice(&2_u64.to_le_bytes());
        }
        let opened = reopen(&directory.replay(), &bytes, 10);
        prop_assert!(matches!(opened, Err(ReplayError::Refused { .. })), "{:?}", opened);
        let reader = CommitReader::open(&directory.replay());
        prop_assert!(matches!(reader, Err(OpenError::Refused { .. })), "{:?}", reader);
        prop_assert_eq!(fs::read(directory.replay()).unwrap(), bytes);
    }
}

#[test]
fn a_file_of_another_run_is_refused_by_name_and_left_as_it_is() {
    let (directory, _) = filled(100, &[(0, 3)]);
    let path = directory.replay();
    let image = fs::read(&path).unwrap();
    let refused = |image: &[u8], layout: &ReplayLayout, expected: &str| {
        fs::write(&path, image).unwrap();
        let error = Replay::open(&path, layout).unwrap_err();
        assert!(matches!(error, ReplayError::Refused { .. }), "{error}");
        let line = error.to_string();
        assert!(
            line.contains(expected) && line.contains("replay.rows") && !line.contains('\n'),
            "{line}"
        );
        assert_eq!(fs::read(&path).unwrap(), image);
    };
    let patched = |at: usize, bytes: &[u8]| {
        let mut image = image.clone();
        image[at..at + bytes.len()].copy_from_slice(bytes);
        image
    };
    let right = layout(100);
    refused(&patched(0, b"X"), &right, "not a replay file");
    refused(
        &patched(8, &[9]),
        &right,
        "it has format 9; this program reads format 2",
    );
    refused(&patched(40, &[9]), &right, "header is damaged");
    refused(&[], &right, "cut short: 0 bytes");
    refused(&image[..image.len() / 2], &right, "cut short");
    refused(
        &image[..image.len() - 1],
        &right,
        "bytes, and by its header it should have",
    );
    refused(
        &[&image[..], &[0]].concat(),
        &right,
        "bytes, and by its header it should have",
    );
    refused(
        &image,
        &ReplayLayout {
            ring: 101,
            ..right.clone()
        },
        "its ring has 100 rows, this run's 101",
    );
    refused(
        &image,
        &ReplayLayout {
            actors: 4,
            actor_snapshot_words: 0,
            ..right.clone()
        },
        "it has space for 3 actors, this run's 4",
    );
    refused(
        &image,
        &ReplayLayout {
            row: RowLayout::new(2, 1),
            ..right.clone()
        },
        "observations have 1 numbers",
    );
    refused(
        &image,
        &ReplayLayout {
            row: RowLayout::new(1, 2),
            ..right.clone()
        },
        "actions have 1 numbers",
    );
    refused(
        &image,
        &ReplayLayout {
            fingerprint: 1,
            ..right.clone()
        },
        "another configuration",
    );
    assert!(Replay::open(&path, &right).is_ok());

    let none = ReplayLayout {
        ring: 0,
        ..right.clone()
    };
    assert!(matches!(
        Replay::create(&path, &none),
        Err(ReplayError::Impossible { .. })
    ));
    let endless = ReplayLayout {
        ring: u64::MAX / 2,
        ..right
    };
    assert!(matches!(
        Replay::create(&path, &endless),
        Err(ReplayError::Impossible { .. })
    ));
}

#[test]
fn a_replay_is_created_once_and_has_one_writer() {
    let directory = Directory::new();
    let path = directory.replay();
    assert!(matches!(Replay::open(&path, &layout(10)), Err(ReplayError::Missing(_))));
    // What cannot be inspected, here also by root, is not missing.
    std::os::unix::fs::symlink(&path, &path).unwrap();
    let opened = Replay::open(&path, &layout(10));
    assert!(!matches!(opened, Ok(_) | Err(ReplayError::Missing(_))), "{opened:?}");
    std::fs::remove_file(&path).unwrap();
    assert!(matches!(CommitReader::open(&path), Err(OpenError::NotYet { .. })));
    assert!(CommitReader::open_if_ready(&path).unwrap().is_none());
    // Left by a learner that was killed while it created the file.
    fs::write(path.with_extension("rows.new"), "half").unwrap();
    let replay = Replay::create(&path, &layout(10)).unwrap();
    assert_eq!(directory.names(), ["replay.rows"]);
    assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    assert_eq!(fs::metadata(&path).unwrap().len(), offsets(10).end as u64);
    assert!(matches!(Replay::open(&path, &layout(10)), Err(ReplayError::InUse(_))));
    assert!(matches!(
        Replay::create(&path, &layout(10)),
        Err(ReplayError::Exists(_))
    ));
    drop(replay);
    assert!(matches!(
        Replay::create(&path, &layout(10)),
        Err(ReplayError::Exists(_))
    ));
    assert_eq!(directory.names(), ["replay.rows"]);
    assert_eq!(Replay::open(&path, &layout(10)).unwrap().rows(), 0..0);
}

#[test]
fn a_replay_that_another_process_publishes_meanwhile_is_not_changed() {
    let directory = Directory::new();
    let path = directory.replay();
    let unfinished = path.with_extension("rows.new");
    fs::write(&unfinished, "another replay").unwrap();
    let other = fs::File::open(&unfinished).unwrap();
    assert!(file_lock::lock(&other, Duration::ZERO).unwrap());
    std::thread::scope(|scope| {
        let creating = scope.spawn(|| Replay::create(&path, &layout(10)).map(drop));
        // Meanwhile it opens the unfinished file and waits for the lock.
        std::thread::sleep(Duration::from_millis(200));
        fs::rename(&unfinished, &path).unwrap();
        drop(other);
        let created = creating.join().unwrap();
        assert!(matches!(created, Err(ReplayError::Exists(_))), "{created:?}");
    });
    assert_eq!(fs::read(&path).unwrap(), b"another replay");
    assert_eq!(directory.names(), ["replay.rows"]);
}
