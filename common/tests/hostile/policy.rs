//! Invalid policy files.

use std::fs;
use std::path::{Path, PathBuf};

use proptest::prelude::*;
use shoal_common::durable::{self, FileKind};
use shoal_common::network::{Hidden, NetworkLayout};
use shoal_common::policy::PolicyLayout;
use shoal_common::policy_file::{PolicyFile, PolicyFileError};
use tempfile::TempDir;

use crate::bytes::{damage, extreme};

fn layout() -> PolicyLayout {
    PolicyLayout::Deterministic(NetworkLayout::new(2, Hidden::relu([3, 2]), 1))
}

fn policy() -> PolicyFile {
    PolicyFile {
        fingerprint: layout().fingerprint(),
        version: 8,
        env_steps: 9,
        return_mean: -150.25,
        return_std: 94.5,
        episodes: 100,
        parameters: (0..layout().parameters()).map(|i| i as f32).collect(),
    }
}

fn directory() -> (TempDir, PathBuf) {
    let directory = TempDir::new().unwrap();
    let path = directory.path().join("best.policy");
    (directory, path)
}

/// Reads the file. Returns `None` if it is refused; the file must not change.
fn read(path: &Path) -> Option<PolicyFile> {
    let before = fs::read(path).unwrap();
    let read = PolicyFile::read(path, &layout());
    assert_eq!(fs::read(path).unwrap(), before);
    match read {
        Ok(policy) => {
            assert_eq!(policy.parameters.len(), layout().parameters());
            Some(policy)
        }
        Err(PolicyFileError::Refused { .. }) => None,
        Err(error) => panic!("{error}"),
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let (_directory, path) = directory();
        fs::write(&path, bytes).unwrap();
        prop_assert_eq!(read(&path), None);
    }

    #[test]
    fn a_damaged_policy_is_refused(damage in prop::collection::vec(damage(), 1..5)) {
        let (_directory, path) = directory();
        policy().write(&path).unwrap();
        let whole = fs::read(&path).unwrap();
        let mut bytes = whole.clone();
        damage.into_iter().for_each(|damage| damage.apply(&mut bytes));
        fs::write(&path, &bytes).unwrap();
        prop_assert_eq!(read(&path), (bytes == whole).then(policy));
    }

    /// With a matching checksum.
    #[test]
    fn a_body_with_false_numbers_is_refused(
        words in prop::array::uniform7(extreme()),
        right_network in any::<bool>(),
        right_count in any::<bool>(),
        numbers in prop::collection::vec(any::<u8>(), 0..120),
    ) {
        const KIND: FileKind = FileKind { magic: *b"SHOALPOL", version: 1, name: "a policy file" };
        let mut words = words;
        if right_network {
            words[0] = layout().fingerprint();
        }
        if right_count {
            words[6] = numbers.len() as u64 / 4;
        }
        let body: Vec<u8> = words.into_iter().flat_map(u64::to_le_bytes).chain(numbers.iter().copied()).collect();
        let (_directory, path) = directory();
        durable::write_atomically(&path, |file| {
            durable::seal(KIND, file, |to| std::io::Write::write_all(to, &body))
        }).unwrap();
        let fits = words[0] == layout().fingerprint() && words[6] == numbers.len() as u64 / 4;
        let whole = fits && numbers.len() == 4 * layout().parameters();
        prop_assert_eq!(read(&path).is_some(), whole);
    }
}

#[test]
fn a_policy_with_a_wrong_number_of_parameters_is_refused() {
    let (_directory, path) = directory();
    for count in [0, 1, layout().parameters() - 1, layout().parameters() + 1] {
        let policy = PolicyFile {
            parameters: vec![0.5; count],
            ..policy()
        };
        policy.write(&path).unwrap();
        let line = PolicyFile::read(&path, &layout()).unwrap_err().to_string();
        assert!(
            line.contains(&format!("it has {count} parameters")) && !line.contains('\n'),
            "{line}"
        );
    }
}
