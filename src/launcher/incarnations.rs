//! The incarnations of a run's processes. None is ever used twice, not even by a resumed run.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use shoal_common::channel::control::HostLease;
use shoal_common::commit::{CommitReader, MAX_INCARNATION, OpenError};
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::RunDir;

use super::log::Log;

/// How many incarnations are skipped if the counter is lost: more than are used between two committed chunks, those of
/// other hosts included.
const STARTS_WITHOUT_CHUNK: u64 = 64 * HostLease::INCARNATIONS;

/// Counts the processes that the run has started, in a file that lasts over resumes.
#[derive(Debug)]
pub(super) struct Incarnations {
    file: PathBuf,
    /// The last incarnation that was taken.
    last: u64,
    /// The number in the file. Those up to it may be taken without writing the file again.
    reserved: u64,
}

impl Incarnations {
    /// Continues after the incarnations that the run has used.
    ///
    /// # Errors
    /// When the file is damaged, or the file or the replay cannot be read.
    pub(super) fn open(run: &RunDir, log: &Log) -> anyhow::Result<Self> {
        let file = run.incarnations();
        let mut last = read_counter(&file)?;
        let committed = last_committed(run)?;
        if last < committed {
            // The counter was lost. A reused incarnation would repeat noise, and its chunks would count as old ones.
            last = committed.saturating_add(STARTS_WITHOUT_CHUNK);
            log.note(
                "launcher",
                &format!("{} is missing or wrong; counting from {last}", file.display()),
            );
        }
        Ok(Self {
            file,
            last,
            reserved: last,
        })
    }

    /// The last incarnation that was taken.
    pub(super) fn last(&self) -> u64 {
        self.last
    }

    /// Makes sure that no later launcher uses the next `count` incarnations. Doing so for several processes at once
    /// saves time: on a slow disk, each writing takes up to a second.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub(super) fn reserve(&mut self, count: u64) -> anyhow::Result<()> {
        let needed = self.last + count;
        if needed > self.reserved {
            write_atomically(&self.file, |file| file.write_all(needed.to_string().as_bytes()))
                .with_context(|| format!("cannot write {}", self.file.display()))?;
            self.reserved = needed;
        }
        Ok(())
    }

    /// Takes the next `count` incarnations. Returns the first of them.
    ///
    /// # Errors
    /// As [`reserve`](Self::reserve).
    pub(super) fn take(&mut self, count: u64) -> anyhow::Result<u64> {
        self.reserve(count)?;
        let first = self.last + 1;
        self.last += count;
        Ok(first)
    }
}

/// The greatest incarnation of an actor in the run's replay.
fn last_committed(run: &RunDir) -> anyhow::Result<u64> {
    let commits = match CommitReader::open(&run.replay_file()) {
        Err(OpenError::NotYet { .. }) => return Ok(0),
        opened => opened?,
    };
    let incarnations = (0..commits.layout().actors).map(|actor| commits.committed(actor).incarnation);
    Ok(incarnations.max().unwrap_or(0))
}

/// The number in the file at `path`; 0 if there is no file.
fn read_counter(path: &Path) -> anyhow::Result<u64> {
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
