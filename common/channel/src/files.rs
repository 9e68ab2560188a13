//! A run's files in shared memory.

use std::fs::Metadata;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

pub(super) const SHARED_MEMORY: &str = "/dev/shm";

/// The prefix of the run's file names in shared memory.
pub(super) fn prefix(run_id: &str) -> String {
    format!("shoal_{run_id}_")
}

/// The run's files in shared memory. Files of other users with the same prefix are ignored.
pub(super) fn files_of(run_id: &str) -> io::Result<Vec<(PathBuf, Metadata)>> {
    let (user, prefix) = (rustix::process::getuid().as_raw(), prefix(run_id));
    let ours = std::fs::read_dir(SHARED_MEMORY)?
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
        // Skip a file that was removed in between.
        .filter_map(|entry| Some((entry.path(), entry.metadata().ok()?)))
        .filter(|(_, metadata)| metadata.uid() == user);
    Ok(ours.collect())
}
