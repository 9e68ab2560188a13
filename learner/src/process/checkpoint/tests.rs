use std::os::unix::fs::PermissionsExt;

use proptest::prelude::*;
use tempfile::TempDir;

use super::*;
use crate::algorithms::algorithm::SavedState;

const WEIGHTS: [f32; 5] = [1.0, -0.0, f32::MIN_POSITIVE, f32::INFINITY, 1e-40];

fn counters(updates: u64) -> Counters {
    Counters {
        updates,
        rows: 3 * updates,
        episodes: 2,
        policy_version: 4,
    }
}

fn save(store: &mut Checkpoints, updates: u64) {
    store
        .save(
            &counters(updates),
            &[("actor", &WEIGHTS), ("empty", &[]), ("critic", &[updates as f32])],
        )
        .unwrap();
}

/// A directory with `latest.ckpt` after two updates and `previous.ckpt` after one.
fn two() -> (TempDir, PathBuf, PathBuf) {
    let directory = TempDir::new().unwrap();
    let mut store = Checkpoints::new(directory.path(), 7);
    save(&mut store, 1);
    save(&mut store, 2);
    let (latest, previous) = (directory.path().join(LATEST), directory.path().join(PREVIOUS));
    (directory, latest, previous)
}

fn load(directory: &TempDir) -> Result<Option<LoadedCheckpoint>, CheckpointError> {
    Checkpoints::new(directory.path(), 7).load_newest()
}

fn updates(directory: &TempDir) -> u64 {
    load(directory).unwrap().unwrap().checkpoint.counters.updates
}

#[test]
fn an_empty_directory_has_no_checkpoint() {
    assert_eq!(load(&TempDir::new().unwrap()).unwrap(), None);
}

#[test]
fn a_saved_checkpoint_is_loaded_bit_for_bit() {
    let (directory, latest, previous) = two();
    let LoadedCheckpoint { checkpoint, warnings } = load(&directory).unwrap().unwrap();
    assert!(warnings.is_empty());
    assert_eq!(checkpoint.counters, counters(2));
    let mut saved = SavedState::from(checkpoint.arrays);
    let actor = saved.take("actor", 5).unwrap();
    assert_eq!(actor.map_bits(), WEIGHTS.to_vec().map_bits());
    assert_eq!(saved.take("empty", 0).unwrap(), [0.0_f32; 0]);
    let error = saved.take("critic", 2).unwrap_err().to_string();
    assert!(error.contains("`critic` has 1 numbers instead of 2"), "{error}");
    assert!(
        saved
            .take("actor", 5)
            .unwrap_err()
            .to_string()
            .contains("`actor` is missing")
    );
    for file in [latest, previous] {
        assert_eq!(fs::metadata(file).unwrap().permissions().mode() & 0o777, 0o600);
    }
}

trait MapBits {
    fn map_bits(self) -> Vec<u32>;
}

impl MapBits for Vec<f32> {
    fn map_bits(self) -> Vec<u32> {
        self.into_iter().map(f32::to_bits).collect()
    }
}

#[test]
fn a_newest_checkpoint_cut_short_anywhere_falls_back_to_the_previous_one() {
    let (directory, latest, _) = two();
    let whole = fs::read(&latest).unwrap();
    for length in 0..whole.len() {
        fs::write(&latest, &whole[..length]).unwrap();
        let loaded = load(&directory).unwrap().unwrap();
        assert_eq!(loaded.checkpoint.counters.updates, 1, "cut to {length} bytes");
        assert!(loaded.warnings[0].contains("latest.ckpt: is"), "{:?}", loaded.warnings);
        assert!(
            loaded.warnings[1].contains("previous.ckpt, after 1 updates"),
            "{:?}",
            loaded.warnings
        );
    }
}

#[test]
fn a_newest_checkpoint_changed_anywhere_falls_back_to_the_previous_one() {
    let (directory, latest, _) = two();
    let whole = fs::read(&latest).unwrap();
    for at in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x10;
        fs::write(&latest, damaged).unwrap();
        assert_eq!(updates(&directory), 1, "byte {at}");
    }
}

#[test]
fn if_all_are_damaged_nothing_is_loaded_and_nothing_changes() {
    let (directory, latest, previous) = two();
    fs::write(&latest, "short").unwrap();
    fs::write(&previous, [0; 4096]).unwrap();
    let error = load(&directory).unwrap_err();
    assert!(matches!(error, CheckpointError::AllDamaged { .. }));
    let line = error.to_string();
    assert!(
        line.contains(LATEST) && line.contains(PREVIOUS) && !line.contains('\n'),
        "{line}"
    );
    assert_eq!(fs::read(&latest).unwrap(), b"short");
    // If a run begins again here, it keeps them under another name.
    save(&mut Checkpoints::new(directory.path(), 7), 9);
    assert_eq!(fs::read(directory.path().join("damaged-0.ckpt")).unwrap(), b"short");
    assert_eq!(updates(&directory), 9);
}

#[test]
fn a_damaged_newest_checkpoint_never_replaces_the_previous_one() {
    for look_first in [true, false] {
        let (directory, latest, previous) = two();
        let kept = fs::read(&previous).unwrap();
        fs::write(&latest, "short").unwrap();
        let mut store = Checkpoints::new(directory.path(), 7);
        if look_first {
            store.load_newest().unwrap();
        }
        save(&mut store, 3);
        assert_eq!(fs::read(&previous).unwrap(), kept);
        assert_eq!(fs::read(directory.path().join("damaged-0.ckpt")).unwrap(), b"short");
        save(&mut store, 4);
        fs::remove_file(&latest).unwrap();
        assert_eq!(updates(&directory), 3);
    }
}

#[test]
fn a_kill_while_writing_leaves_the_last_checkpoints() {
    let (directory, latest, _) = two();
    fs::write(latest.with_extension("ckpt.new"), "half").unwrap();
    assert_eq!(updates(&directory), 2);
    save(&mut Checkpoints::new(directory.path(), 7), 3);
    assert_eq!(updates(&directory), 3);
}

#[test]
fn a_checkpoint_of_another_configuration_is_refused_and_not_replaced() {
    let (directory, latest, _) = two();
    let before = fs::read(&latest).unwrap();
    let mut other = Checkpoints::new(directory.path(), 8);
    let error = other.load_newest().unwrap_err().to_string();
    assert!(
        error.contains("latest.ckpt") && error.contains("another configuration"),
        "{error}"
    );
    let mut other = Checkpoints::new(directory.path(), 8);
    assert!(matches!(
        other.save(&counters(3), &[]),
        Err(CheckpointError::Refused { .. })
    ));
    assert_eq!(fs::read(&latest).unwrap(), before);
    assert!(!latest.with_extension("ckpt.new").exists());
}

#[test]
fn a_checkpoint_that_cannot_be_opened_is_refused_and_not_put_aside() {
    let (directory, latest, _) = two();
    let before = fs::read(&latest).unwrap();
    let away = latest.with_extension("away");
    fs::rename(&latest, &away).unwrap();
    // A link to itself cannot be opened, not even by root.
    std::os::unix::fs::symlink(&latest, &latest).unwrap();
    let is_refused = |result: Result<(), CheckpointError>| matches!(result, Err(CheckpointError::Read { .. }));
    assert!(is_refused(load(&directory).map(drop)));
    assert!(is_refused(
        Checkpoints::new(directory.path(), 7).save(&counters(3), &[])
    ));
    fs::rename(away, &latest).unwrap();
    assert_eq!(fs::read(&latest).unwrap(), before);
    assert_eq!(updates(&directory), 2);
}

#[test]
fn a_checkpoint_of_another_version_is_refused() {
    let (directory, latest, _) = two();
    durable::write_atomically(&latest, |file| {
        durable::seal(FileKind { version: 1, ..KIND }, file, |_| Ok(()))
    })
    .unwrap();
    let error = load(&directory).unwrap_err().to_string();
    assert!(error.contains("has format 1; this program reads format 2"), "{error}");
}

#[test]
fn a_missing_directory_is_named() {
    let directory = TempDir::new().unwrap().path().join("gone");
    let error = Checkpoints::new(&directory, 7).save(&counters(1), &[]).unwrap_err();
    assert!(matches!(error, CheckpointError::Write { .. }));
    assert!(error.to_string().contains("gone/latest.ckpt"), "{error}");
}

proptest! {
    #[test]
    fn any_body_is_read_or_refused(body in prop::collection::vec(any::<u8>(), 0..300)) {
        let _ = parse(&body);
    }

    #[test]
    fn a_header_with_a_wrong_length_is_refused(length in any::<u64>(), numbers in 0_usize..20) {
        let header = Header { fingerprint: 0, counters: Counters::default(), arrays: vec![("a".into(), length)] };
        let mut body = bincode::serde::encode_to_vec(&header, encoding()).unwrap();
        body.resize(body.len() + 4 * numbers, 0);
        prop_assert_eq!(parse(&body).is_some(), length == numbers as u64);
    }
}
