//! What killed processes leave in shared memory, and how it is removed.
//!
//! iceoryx2 0.10 makes a file in steps (create, size, fill, open to readers), and opens one that stops half-way again and
//! again: for a second, or as root for ever where it has no size yet. So files whose maker is dead are removed here as soon as
//! they are seen. And it leaves a port in its service for good where the file that tells of the port is gone first; so that
//! file is put back before iceoryx2 cleans up.

use std::collections::HashSet;
use std::fs::Metadata;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::prelude::{CallbackProgression, Config, Node, NodeState, ipc};
use rustix::process::{Pid, test_kill_process};

use super::domain::{Domain, DomainError, io_error, iox_config, user_root};
use super::error::ChannelError;
use super::files::{SHARED_MEMORY, files_of};
use super::memory::is_promise;

/// How often the sweeper looks. Whoever opens a half-made file is held up for so long at most.
const SWEEP: Duration = Duration::from_millis(250);

/// A file that is younger may be in the making, even where the system does not tell who has it open: that takes some
/// microseconds.
const YOUNG: Duration = Duration::from_millis(50);

/// How long a clean-up waits for half-made files that may have living makers.
const MAKERS: Duration = Duration::from_millis(200);

/// How long iceoryx2 may wait for another process that cleans up after the same dead one.
const OTHER_CLEANER: Duration = Duration::from_millis(100);

/// A thread that removes what killed processes have half made, until this is dropped.
#[derive(Debug)]
pub struct Sweeper {
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Sweeper {
    /// Starts to sweep the files of a run: for its launcher, and for who asks a launcher that may be killed over the answer.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start(domain: &Domain) -> Result<Self, ChannelError> {
        let (stop, stopped) = mpsc::channel();
        let run_id = domain.run_id().to_owned();
        let sweep = move || {
            while stopped.recv_timeout(SWEEP) == Err(RecvTimeoutError::Timeout) {
                if let Err(error) = remove_unfinished(&run_id) {
                    tracing::warn!("cannot look for files that killed processes have left: {error}");
                }
            }
        };
        let thread = std::thread::Builder::new()
            .name("sweeper".into())
            .spawn(sweep)
            .map_err(|cause| ChannelError::new("all", "be watched", cause))?;
        Ok(Self {
            stop: Some(stop),
            thread: Some(thread),
        })
    }
}

impl Drop for Sweeper {
    fn drop(&mut self) {
        self.stop = None;
        // It has nothing to tell.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Removes files that a process was making when it was killed; whether no half-made file is left.
pub(super) fn remove_unfinished(run_id: &str) -> io::Result<bool> {
    let mut unfinished = files_of(run_id)?;
    unfinished.retain(|(path, metadata)| is_unfinished(path, metadata));
    if unfinished.is_empty() {
        return Ok(true);
    }
    // A maker has its file open from the first moment to the last. Whoever merely tries to open it has it so for moments:
    // such a file is removed the next time.
    let open = open_files();
    let mut none_left = true;
    for (path, before) in unfinished {
        match path.symlink_metadata() {
            Err(_) => {}
            Ok(now) if now.ino() != before.ino() || !is_unfinished(&path, &now) => {}
            Ok(now) if open.contains(&path) || is_young(&now) => none_left = false,
            Ok(_) => match std::fs::remove_file(&path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => tracing::debug!(path = %path.display(), "removed a file whose maker was killed"),
            },
        }
    }
    Ok(none_left)
}

/// Whether iceoryx2 has not finished the file: it has no size yet, or may not be read yet.
fn is_unfinished(path: &Path, metadata: &Metadata) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy());
    let is_promise = name.is_some_and(|name| is_promise(&name));
    metadata.is_file() && !is_promise && (metadata.len() == 0 || metadata.mode() & 0o400 == 0)
}

fn is_young(metadata: &Metadata) -> bool {
    let since = Duration::new(metadata.ctime().max(0) as u64, metadata.ctime_nsec() as u32);
    // A clock that was set back says nothing.
    (SystemTime::UNIX_EPOCH + since).elapsed().is_ok_and(|age| age < YOUNG)
}

/// Files of shared memory that some process has open.
fn open_files() -> HashSet<PathBuf> {
    let listed = |path: PathBuf| std::fs::read_dir(path).into_iter().flatten().flatten();
    listed("/proc".into())
        .filter(|process| process.file_name().to_string_lossy().parse::<u32>().is_ok())
        .flat_map(|process| listed(process.path().join("fd")))
        .filter_map(|descriptor| std::fs::read_link(descriptor.path()).ok())
        .filter(|file| file.starts_with(SHARED_MEMORY))
        .collect()
}

impl Domain {
    /// Removes from the services of run `run_id` whatever processes left in them that are no more; how many of those could
    /// not be cleaned up after. Killed over it, it can be begun anew.
    ///
    /// # Errors
    /// When files cannot be listed or removed.
    pub fn clean_up(run_id: &str) -> Result<u32, DomainError> {
        let root = user_root()?;
        let config = iox_config(&root, run_id).map_err(|cause| DomainError::Join {
            run_id: run_id.into(),
            cause,
        })?;
        // A connection that is half made would cost its port's place.
        let deadline = Instant::now() + MAKERS;
        let listing = || io_error("clean up", Path::new(SHARED_MEMORY));
        while !remove_unfinished(run_id).map_err(listing())? && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(clean_up_dead_nodes(&config))
    }
}

impl Domain {
    /// Whether processes of the run have died and nobody has cleaned up after them.
    pub fn has_dead_nodes(&self) -> bool {
        let mut dead = false;
        let listed = Node::<ipc::Service>::list(self.node().config(), |state| {
            dead = matches!(state, NodeState::Dead(_));
            if dead {
                CallbackProgression::Stop
            } else {
                CallbackProgression::Continue
            }
        });
        dead && listed.is_ok()
    }
}

fn clean_up_dead_nodes(config: &Config) -> u32 {
    let mut failed = 0;
    let listed = Node::<ipc::Service>::list(config, |state| {
        if let NodeState::Dead(node) = state
            && let Err(error) = node.blocking_remove_stale_resources(OTHER_CLEANER)
        {
            tracing::debug!(?error, "could not clean up after a process");
            failed += 1;
        }
        CallbackProgression::Continue
    });
    failed + u32::from(listed.is_err())
}

/// Whether the process that made the node lives.
pub(super) fn lives(node: UniqueNodeId) -> bool {
    let pid = node
        .pid::<ipc::Service>()
        .ok()
        .and_then(|pid| Pid::from_raw(pid.value()));
    pid.is_some_and(|pid| test_kill_process(pid).is_ok())
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::os::unix::fs::PermissionsExt;

    use super::super::files::prefix;
    use super::*;

    /// A file of a run of this test's own, removed with it.
    struct Left(PathBuf);

    impl Left {
        fn new(name: &str, mode: u32, bytes: &[u8]) -> (Self, File) {
            let path = Path::new(SHARED_MEMORY).join(format!("{}{name}", prefix(&run_id())));
            std::fs::write(&path, bytes).unwrap();
            let file = File::open(&path).unwrap();
            file.set_permissions(std::fs::Permissions::from_mode(mode)).unwrap();
            (Self(path), file)
        }
    }

    impl Drop for Left {
        fn drop(&mut self) {
            let _ = std::fs::remove_file(&self.0);
        }
    }

    fn run_id() -> String {
        format!("u{}", std::process::id())
    }

    #[test]
    fn what_a_dead_process_was_making_is_removed_and_nothing_else() {
        let ((empty, making), (closed, filling)) = (
            Left::new("1_2.connection", 0o200, b""),
            Left::new("1_3.connection", 0o200, b"half"),
        );
        let (whole, _) = Left::new("1.data", 0o600, b"whole");
        let (promise, _) = Left::new("promise_4096", 0o600, b"");
        std::thread::sleep(2 * YOUNG);
        assert!(!remove_unfinished(&run_id()).unwrap());
        assert!(empty.0.exists() && closed.0.exists(), "their maker lives");
        drop((making, filling));
        assert!(remove_unfinished(&run_id()).unwrap());
        assert!(!empty.0.exists() && !closed.0.exists());
        assert!(whole.0.exists() && promise.0.exists());
    }
}
