//! Directories of runs whose start was interrupted: `train` was killed before the run could be resumed.

use std::path::Path;

use anyhow::Context;
use shoal_common::run_dir::RunDir;

use crate::files::is_there;
use crate::origin::Origin;

/// The names, or beginnings of names, of the files that exist before `config.toml`.
const FIRST_FILES: [&str; 3] = ["server.json", "description.json", "config.toml."];

/// Removes the directory at `path` if the start of a run in it was interrupted. Returns whether nothing is at `path` now.
/// A directory with anything else in it is left alone.
///
/// # Errors
/// When the directory cannot be read or removed.
pub fn remove_interrupted_start(path: &Path) -> anyhow::Result<bool> {
    // A start that was killed at once leaves an empty directory.
    let _ = std::fs::remove_dir(path);
    if !is_there(path)? {
        return Ok(true);
    }
    let run = RunDir::at(path);
    // Whoever holds the lock is starting the run, or works on it.
    let Ok(_lock) = run.lock() else { return Ok(false) };
    let is_interrupted = is_interrupted(&run)?;
    if is_interrupted {
        run.remove()
            .with_context(|| format!("cannot remove {}", path.display()))?;
    }
    Ok(is_interrupted)
}

fn is_interrupted(run: &RunDir) -> anyhow::Result<bool> {
    if is_there(&run.incarnations())? {
        return Ok(false);
    }
    if is_there(&run.config_file())? {
        // `origin.json` is written after the networks and rows that the run begins with.
        return Ok(run.config()?.run.has_origin() && Origin::read(run)?.is_none());
    }
    let cannot_read = || format!("cannot read {}", run.path().display());
    let entries = std::fs::read_dir(run.path()).with_context(cannot_read)?;
    for entry in entries {
        let name = entry.with_context(cannot_read)?.file_name();
        let name = name.to_string_lossy();
        if !FIRST_FILES.iter().any(|first| name.starts_with(first)) {
            return Ok(false);
        }
    }
    Ok(true)
}

#[cfg(test)]
mod tests {
    use std::mem::MaybeUninit;

    use rustix::fs::inotify;

    use super::*;
    use crate::plan::resolve_preset;

    #[test]
    fn only_what_an_interrupted_start_left_is_removed() {
        let parent = tempfile::tempdir().unwrap();
        let path = parent.path().join("run");
        let with = |files: &[&str]| {
            let _ = std::fs::remove_dir_all(&path);
            std::fs::create_dir(&path).unwrap();
            files
                .iter()
                .for_each(|name| std::fs::write(path.join(name), "").unwrap());
            remove_interrupted_start(&path).unwrap()
        };
        assert!(with(&[]) && !path.exists());
        assert!(with(&["server.json", "description.json", "config.toml.new"]) && !path.exists());
        assert!(!with(&["server.json", "notes"]) && path.join("notes").exists());
        assert!(!with(&["config.toml.new", "incarnations"]));
        // A file that cannot be inspected, also not by root.
        std::fs::remove_file(path.join("incarnations")).unwrap();
        std::os::unix::fs::symlink(path.join("incarnations"), path.join("incarnations")).unwrap();
        assert!(remove_interrupted_start(&path).is_err() && path.join("config.toml.new").exists());

        let mut config = resolve_preset("pendulum").unwrap();
        let _ = std::fs::remove_dir_all(&path);
        RunDir::create(&path).unwrap().write_config(&config).unwrap();
        assert!(!remove_interrupted_start(&path).unwrap(), "it can be resumed");
        config.run.from = Some("another".into());
        RunDir::open(&path).unwrap().write_config(&config).unwrap();
        let lock = RunDir::open(&path).unwrap().lock().unwrap();
        assert!(!remove_interrupted_start(&path).unwrap(), "it is being started");
        drop(lock);
        assert!(remove_interrupted_start(&path).unwrap(), "it has no networks");
        assert!(!path.exists());
    }

    #[test]
    fn what_an_interrupted_removal_leaves_is_removed_too() {
        let parent = tempfile::tempdir().unwrap();
        let path = parent.path().join("run");
        let mut config = resolve_preset("pendulum").unwrap();
        config.run.from = Some("another".into());
        // Directories may be read in the order in which files were made, or the other way round.
        for configured_first in [true, false] {
            let make = || {
                let run = RunDir::create(&path).unwrap();
                let configure = || {
                    run.write_config(&config).unwrap();
                    run.write_used_config(&config).unwrap();
                };
                if configured_first {
                    configure();
                }
                for name in ["server.json", "origin.json", "start.json", "replay.bin", "shoal.log"] {
                    std::fs::write(path.join(name), "").unwrap();
                }
                std::fs::create_dir(run.checkpoints()).unwrap();
                std::fs::write(run.checkpoints().join("latest.ckpt"), "").unwrap();
                if !configured_first {
                    configure();
                }
                run
            };
            let order = order_of_removal(&make());
            assert_eq!(order.len(), 8, "{order:?}");
            for removed in 1..=order.len() {
                make();
                for name in &order[..removed] {
                    let entry = path.join(name);
                    let is_directory = entry.is_dir();
                    let remove = if is_directory {
                        std::fs::remove_dir_all
                    } else {
                        std::fs::remove_file
                    };
                    remove(&entry).unwrap();
                }
                let left = &order[removed..];
                assert!(remove_interrupted_start(&path).unwrap(), "{left:?}");
                assert!(!path.exists(), "{left:?}");
            }
        }
    }

    /// Removes the run. Returns what was in its directory, in the order in which it was removed.
    fn order_of_removal(run: &RunDir) -> Vec<String> {
        let watch = inotify::init(inotify::CreateFlags::NONBLOCK).unwrap();
        inotify::add_watch(&watch, run.path(), inotify::WatchFlags::DELETE).unwrap();
        run.remove().unwrap();
        assert!(!run.path().exists());
        let mut buffer = [MaybeUninit::uninit(); 4096];
        let mut events = inotify::Reader::new(watch, &mut buffer);
        let mut removed = Vec::new();
        while let Ok(event) = events.next() {
            // The directory's own end has no name.
            removed.extend(event.file_name().map(|name| name.to_str().unwrap().to_owned()));
        }
        removed
    }
}
