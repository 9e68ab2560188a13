//! Which actors the learner's host has, in a file of the run. Without the file, the next launcher would take the first
//! indices. Some of those may belong to a joined host, with chunks that are not committed yet.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use shoal_common::run_dir::RunDir;
use shoal_common::versioned_file::VersionedFile;
use shoal_run::files::remove_if_any;

#[derive(Serialize, Deserialize)]
struct LocalActors {
    indices: BTreeSet<u32>,
}

impl VersionedFile for LocalActors {
    const FORMAT: u32 = 1;
    const IF_DAMAGED: &'static str = "; remove it, and the run continues with its first actors";
}

/// The `count` actors that this host begins with, each below `limit`, in ascending order. Those that an earlier
/// launcher stored come first; the lowest other indices fill the rest.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn read(run: &RunDir, count: u32, limit: u32) -> anyhow::Result<Vec<u32>> {
    let stored = LocalActors::load_if_any(&run.local_actors())?.map_or_else(BTreeSet::new, |stored| stored.indices);
    let others = (0..limit).filter(|index| !stored.contains(index));
    let preferred = stored.iter().copied().filter(|index| *index < limit).chain(others);
    let actors: BTreeSet<u32> = preferred.take(count as usize).collect();
    Ok(actors.into_iter().collect())
}

/// Stores the actors of this host for the next launcher. The first ones need no file.
///
/// # Errors
/// When the file cannot be written or removed.
pub(super) fn write(run: &RunDir, actors: &[u32]) -> anyhow::Result<()> {
    let file = run.local_actors();
    if !actors.iter().copied().eq(0..actors.len() as u32) {
        let indices = actors.iter().copied().collect();
        return Ok(LocalActors { indices }.store(&file)?);
    }
    remove_if_any(&file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_next_launcher_gets_the_same_actors_and_the_first_others() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDir::at(directory.path());
        assert_eq!(read(&run, 3, 16).unwrap(), [0, 1, 2]);
        write(&run, &[0, 3, 4]).unwrap();
        assert_eq!(read(&run, 3, 16).unwrap(), [0, 3, 4]);
        assert_eq!(read(&run, 2, 16).unwrap(), [0, 3]);
        assert_eq!(read(&run, 5, 16).unwrap(), [0, 1, 2, 3, 4]);
        assert_eq!(read(&run, 3, 4).unwrap(), [0, 1, 3]);
        write(&run, &[0, 1]).unwrap();
        assert!(!run.local_actors().exists());
        assert_eq!(read(&run, 3, 16).unwrap(), [0, 1, 2]);
        write(&run, &[0, 1]).unwrap();
        std::fs::write(run.local_actors(), "{}").unwrap();
        assert!(read(&run, 3, 16).unwrap_err().to_string().contains("actors.json"));
    }
}
