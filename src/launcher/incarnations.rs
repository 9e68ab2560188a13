//! The number of processes that a run has started. An incarnation is never used twice, not even by a resumed run.

use std::path::Path;

use anyhow::Context;
use shoal_common::commit::{CommitReader, MAX_INCARNATION, OpenError};
use shoal_common::run_dir::RunDir;

/// The greatest incarnation of an actor in the run's replay.
pub(super) fn last_committed(run: &RunDir) -> anyhow::Result<u64> {
    let commits = match CommitReader::open(&run.replay_file()) {
        Err(OpenError::NotYet { .. }) => return Ok(0),
        opened => opened?,
    };
    let incarnations = (0..commits.layout().actors).map(|actor| commits.committed(actor).incarnation);
    Ok(incarnations.max().unwrap_or(0))
}

/// The number in the file at `path`; 0 if there is no file.
pub(super) fn read_counter(path: &Path) -> anyhow::Result<u64> {
    let text = match std::fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(0),
        text => text.with_context(|| format!("cannot read {}", path.display()))?,
    };
    let number = std::str::from_utf8(&text)
        .ok()
        .and_then(|text| text.trim().parse().ok());
    number.filter(|started| *started < MAX_INCARNATION).with_context(|| {
        format!(
            "{} is damaged: remove it; the count then continues from the replay's highest incarnation",
            path.display()
        )
    })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn counted(bytes: &[u8]) -> anyhow::Result<u64> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("incarnations");
        std::fs::write(&path, bytes).unwrap();
        let counted = read_counter(&path);
        assert_eq!(std::fs::read(path).unwrap(), bytes);
        counted
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn any_counter_file_is_read_as_a_number_below_the_limit_or_refused(
            bytes in prop_oneof![
                prop::collection::vec(any::<u8>(), 0..30),
                "[ +-]?[0-9]{0,25}\n?".prop_map(String::into_bytes),
                any::<u64>().prop_map(|n| n.to_string().into_bytes()),
            ],
        ) {
            match counted(&bytes) {
                Ok(started) => prop_assert!(started < 1 << 60),
                Err(error) => prop_assert!(error.to_string().contains("incarnations is damaged"), "{}", error),
            }
        }
    }

    #[test]
    fn a_missing_counter_is_zero_and_an_invalid_one_is_refused() {
        assert_eq!(read_counter(Path::new("/nowhere/incarnations")).unwrap(), 0);
        assert_eq!(counted(b"17").unwrap(), 17);
        assert!(counted(b"18446744073709551615").is_err() && counted(b"").is_err());
    }
}
