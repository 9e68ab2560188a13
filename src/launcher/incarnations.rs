//! How many processes a run has started: incarnations are never used twice, not by a resumed run either.

use std::path::Path;

use anyhow::Context;
use shoal_common::commit::{CommitReader, LAST_INCARNATION, OpenError};
use shoal_common::run_dir::RunDir;

/// The greatest incarnation of an actor that is in the run's replay.
pub(super) fn last_committed(run: &RunDir) -> anyhow::Result<u64> {
    let commits = match CommitReader::open(&run.replay_file()) {
        Err(OpenError::NotYet { .. }) => return Ok(0),
        opened => opened?,
    };
    let marks = (0..commits.layout().actors).map(|actor| commits.committed(actor).incarnation);
    Ok(marks.max().unwrap_or(0))
}

/// The number in the file at `path`, 0 where there is none.
pub(super) fn read_counter(path: &Path) -> anyhow::Result<u64> {
    let text = match std::fs::read(path) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(0),
        text => text.with_context(|| format!("cannot read {}", path.display()))?,
    };
    let number = std::str::from_utf8(&text)
        .ok()
        .and_then(|text| text.trim().parse().ok());
    number.filter(|started| *started < LAST_INCARNATION).with_context(|| {
        format!(
            "{} is damaged: write a number into it that is greater than every incarnation in the run's log",
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
        fn a_counter_is_a_number_that_can_be_counted_on_or_refused(
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
    fn a_counter_that_is_not_there_is_none() {
        assert_eq!(read_counter(Path::new("/nowhere/incarnations")).unwrap(), 0);
        assert_eq!(counted(b"17").unwrap(), 17);
        assert!(counted(b"18446744073709551615").is_err() && counted(b"").is_err());
    }
}
