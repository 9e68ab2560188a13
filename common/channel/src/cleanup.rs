//! Removal of what killed processes leave in shared memory.
//!
//! iceoryx2 0.10 creates a file in steps: create, set the size, fill, make readable. If a process dies in between,
//! others retry to open its unfinished file for a second, or forever if they run as root and the file has no size yet.
//! So unfinished files of dead processes are removed here as soon as they are seen.
//!
//! iceoryx2 also never frees a port whose port tag is removed before the port. So missing tags are restored before
//! iceoryx2 cleans up ([`Services::restore_port_tags`](super::Services::restore_port_tags)). `tests/iceoryx2.rs` shows
//! both faults.

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
use super::membership::is_members_file;
use super::memory::is_reservation;

/// Interval between two sweeps: the longest time that an unfinished file of a dead process delays other processes.
const SWEEP_INTERVAL: Duration = Duration::from_millis(250);

/// The least age of a file that is removed. A younger one may still be in creation, which takes some microseconds,
/// although no process seems to have it open.
const MIN_AGE: Duration = Duration::from_millis(50);

/// How long a clean-up waits for unfinished files whose makers may be alive.
const MAKER_TIMEOUT: Duration = Duration::from_millis(200);

/// How long iceoryx2 may wait for another process that cleans up after the same dead process.
const OTHER_CLEANER_TIMEOUT: Duration = Duration::from_millis(100);

/// A thread that removes unfinished files of killed processes until this is dropped.
#[derive(Debug)]
pub struct Sweeper {
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl Sweeper {
    /// Starts to remove unfinished files of a run. It is used by the run's launcher, and by a process that asks a
    /// launcher, because the launcher may be killed while it answers.
    ///
    /// # Errors
    /// When the thread cannot be started.
    pub fn start(domain: &Domain) -> Result<Self, ChannelError> {
        let (stop, stopped) = mpsc::channel();
        let run_id = domain.run_id().to_owned();
        let sweep = move || {
            while stopped.recv_timeout(SWEEP_INTERVAL) == Err(RecvTimeoutError::Timeout) {
                if let Err(error) = remove_unfinished(&run_id) {
                    tracing::warn!("cannot remove unfinished files of killed processes: {error}");
                }
            }
        };
        let thread = std::thread::Builder::new()
            .name("sweeper".into())
            .spawn(sweep)
            .map_err(|cause| ChannelError::new("of the run", "start the sweeper thread", cause))?;
        Ok(Self {
            stop: Some(stop),
            thread: Some(thread),
        })
    }
}

impl Drop for Sweeper {
    fn drop(&mut self) {
        self.stop = None;
        // The thread returns nothing.
        let _ = self.thread.take().map(JoinHandle::join);
    }
}

/// Removes unfinished files of killed processes. Returns whether none is left.
pub(super) fn remove_unfinished(run_id: &str) -> io::Result<bool> {
    let mut unfinished = files_of(run_id)?;
    unfinished.retain(|(path, metadata)| is_unfinished(path, metadata));
    if unfinished.is_empty() {
        return Ok(true);
    }
    // The maker keeps its file open until it is finished. Another process that only tries to open the file has it open
    // for a moment; the file is then removed by the next sweep.
    let open = open_files();
    let mut none_left = true;
    for (path, before) in unfinished {
        match path.symlink_metadata() {
            Err(_) => {}
            Ok(now) if now.ino() != before.ino() || !is_unfinished(&path, &now) => {}
            Ok(now) if open.contains(&path) || is_recent(&now) => none_left = false,
            Ok(_) => match std::fs::remove_file(&path) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                _ => tracing::debug!(path = %path.display(), "removed a file whose maker was killed"),
            },
        }
    }
    Ok(none_left)
}

/// Whether iceoryx2 has not finished the file: it has no size, or is not readable.
fn is_unfinished(path: &Path, metadata: &Metadata) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy());
    let is_ours = name.is_some_and(|name| is_reservation(&name) || is_members_file(&name));
    metadata.is_file() && !is_ours && (metadata.len() == 0 || metadata.mode() & 0o400 == 0)
}

fn is_recent(metadata: &Metadata) -> bool {
    let since = Duration::new(metadata.ctime().max(0) as u64, metadata.ctime_nsec() as u32);
    // A time in the future means that the clock was set back: the age is then unknown and counts as sufficient.
    (SystemTime::UNIX_EPOCH + since)
        .elapsed()
        .is_ok_and(|age| age < MIN_AGE)
}

/// Files in shared memory that any process has open.
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
    /// Cleans up after the dead processes of run `run_id`. Returns the number of processes for which that failed. If
    /// the caller is killed during a clean-up, the clean-up can be repeated.
    ///
    /// # Errors
    /// When files cannot be listed or removed.
    pub fn clean_up(run_id: &str) -> Result<u32, DomainError> {
        let root = user_root()?;
        let config = iox_config(&root, run_id).map_err(|cause| DomainError::SharedMemory {
            action: "clean up after",
            run_id: run_id.into(),
            cause,
        })?;
        // iceoryx2 would never free a port with an unfinished connection, so unfinished connections are removed first.
        let deadline = Instant::now() + MAKER_TIMEOUT;
        let listing = || io_error("clean up", Path::new(SHARED_MEMORY));
        while !remove_unfinished(run_id).map_err(listing())? && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(clean_up_dead_nodes(&config))
    }
}

impl Domain {
    /// Whether there are dead processes of the run that need a clean-up.
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
            && let Err(error) = node.blocking_remove_stale_resources(OTHER_CLEANER_TIMEOUT)
        {
            tracing::debug!(?error, "could not clean up after a process");
            failed += 1;
        }
        CallbackProgression::Continue
    });
    failed + u32::from(listed.is_err())
}

/// Whether the process that made the node is alive.
pub(super) fn is_alive(node: UniqueNodeId) -> bool {
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
    use super::super::membership::Membership;
    use super::*;

    /// A file of this test's own run, removed on drop.
    struct Leftover(PathBuf);

    impl Leftover {
        fn new(name: &str, mode: u32, bytes: &[u8]) -> (Self, File) {
            let path = Path::new(SHARED_MEMORY).join(format!("{}{name}", prefix(&run_id())));
            std::fs::write(&path, bytes).unwrap();
            let file = File::open(&path).unwrap();
            file.set_permissions(std::fs::Permissions::from_mode(mode)).unwrap();
            (Self(path), file)
        }
    }

    impl Drop for Leftover {
        fn drop(&mut self) {
            let _ = std::fs::remove_file(&self.0);
        }
    }

    fn run_id() -> String {
        format!("u{}", std::process::id())
    }

    #[test]
    fn only_unfinished_files_of_dead_processes_are_removed() {
        // Without a member of their run, another run that starts now would remove these files.
        let (members, _) = Leftover::new("members", 0o600, b"");
        let _membership = Membership::enter(&run_id()).unwrap();
        let ((empty, making), (closed, filling)) = (
            Leftover::new("1_2.connection", 0o200, b""),
            Leftover::new("1_3.connection", 0o200, b"half"),
        );
        let (whole, _) = Leftover::new("1.data", 0o600, b"whole");
        let reserved = ["reserved_4096", "promise_4096"].map(|name| Leftover::new(name, 0o600, b"").0);
        std::thread::sleep(2 * MIN_AGE);
        assert!(!remove_unfinished(&run_id()).unwrap());
        assert!(empty.0.exists() && closed.0.exists(), "their maker is alive");
        drop((making, filling));
        assert!(remove_unfinished(&run_id()).unwrap());
        assert!(!empty.0.exists() && !closed.0.exists());
        assert!(whole.0.exists() && members.0.exists());
        assert!(
            reserved.iter().all(|file| file.0.exists()),
            "reservations of this and of earlier versions"
        );
    }
}
