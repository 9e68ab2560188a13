//! The names of a run's files in shared memory.

use std::fs::Metadata;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::PathBuf;

pub(super) const SHARED_MEMORY: &str = "/dev/shm";

/// File names of the run in shared memory begin with this.
pub(super) fn prefix(run_id: &str) -> String {
    format!("shoal_{run_id}_")
}

/// The run's files in shared memory. Others may put files there whose names begin alike: theirs are left alone.
pub(super) fn files_of(run_id: &str) -> io::Result<Vec<(PathBuf, Metadata)>> {
    let (user, prefix) = (rustix::process::getuid().as_raw(), prefix(run_id));
    let ours = std::fs::read_dir(SHARED_MEMORY)?
        .flatten()
        .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
        // One that has gone in between is none.
        .filter_map(|entry| Some((entry.path(), entry.metadata().ok()?)))
        .filter(|(_, metadata)| metadata.uid() == user);
    Ok(ours.collect())
}
