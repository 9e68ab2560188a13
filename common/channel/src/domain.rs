//! A run's own part of shared memory. Every run has its own file prefix, and its own root directory inside a directory
//! of its user. So runs and users never affect each other, and the leftovers of a killed run can be found by name.

use std::fs::{DirBuilder, File, Metadata, Permissions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use iceoryx2::node::NodeView;
use iceoryx2::prelude::{
    CallbackProgression, Config, FileName, Node, NodeBuilder, NodeName, NodeState, Path as IoxPath, SemanticString,
    SignalHandlingMode, ipc,
};
use shoal_base::file_lock;

use super::files::{SHARED_MEMORY, files_of, prefix};
use super::membership::{self, Claim, Membership};
use super::memory;

/// How long to wait for a run's lock. Each process holds it for some milliseconds, or seconds where the disk is busy.
const LOCK_TIMEOUT: Duration = Duration::from_secs(30);

/// How long a client waits for a run's lock. A client without the lock makes no ports, and leaks those it has instead
/// of dropping them (docs/DESIGN.md#who-is-alive).
const CLIENT_LOCK_TIMEOUT: Duration = Duration::from_secs(1);

/// How a process takes part in a run.
#[derive(Clone, Copy, Debug)]
enum Participant {
    /// A process of the run.
    Member,
    /// A process that only asks the run's launcher something.
    Client,
}

impl Participant {
    /// The name of its node.
    fn node_name(self) -> &'static str {
        match self {
            Self::Member => "",
            // Programs of earlier versions know this name.
            Self::Client => "visitor",
        }
    }
}

/// A process's access to a run in shared memory. All its channels are opened through it.
#[derive(Debug)]
pub struct Domain {
    node: Node<ipc::Service>,
    /// `None` for clients.
    membership: Option<Membership>,
    /// The user's directory, with a shared lock: systemd does not tidy up a locked directory.
    _user_root: Option<File>,
    /// The run's directory in it, as it was when this process joined.
    root: (u64, u64),
    run_id: String,
    max_actors: usize,
}

/// Why a process cannot join or leave a run in shared memory.
#[derive(Debug, thiserror::Error)]
pub enum DomainError {
    /// The system refused.
    #[error("cannot {action} {path}: {cause}")]
    Io {
        /// What was tried, as a verb.
        action: &'static str,
        /// The file or directory.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
    /// Another user owns the directory of this user.
    #[error("{0} belongs to another user; remove it, or ask its owner to")]
    Foreign(PathBuf),
    /// Another process has held the run's lock for too long.
    #[error("{0} is locked by another shoal process that makes no progress; is one stopped?")]
    Locked(PathBuf),
    /// Processes of the run's previous launcher are still alive.
    #[error(
        "run {run_id} cannot continue: some of its processes are still alive and do not end (stopped?){}{}",
        if pids.is_empty() { "" } else { ": kill -9 " },
        pids.iter().map(i32::to_string).collect::<Vec<_>>().join(" ")
    )]
    StillAlive {
        /// The id of the run.
        run_id: String,
        /// The ids of the living processes.
        pids: Vec<i32>,
    },
    /// iceoryx2 refused.
    #[error("cannot {action} run {run_id} in shared memory: {cause}; is /dev/shm mounted and not full?")]
    SharedMemory {
        /// What was tried, as a verb.
        action: &'static str,
        /// The id of the run.
        run_id: String,
        /// iceoryx2's reason.
        cause: String,
    },
}

impl Domain {
    /// Joins the run `run_id`, whose channels are sized for up to `max_actors` actors.
    ///
    /// # Errors
    /// When the user's directory cannot be created, or shared memory is unavailable.
    pub fn join(run_id: &str, max_actors: u32) -> Result<Self, DomainError> {
        Self::enter(run_id, max_actors, Participant::Member)
    }

    /// Joins the run as a client, which only asks its launcher something. The run does not wait for clients to end.
    ///
    /// # Errors
    /// As [`join`](Self::join).
    pub fn join_as_client(run_id: &str, max_actors: u32) -> Result<Self, DomainError> {
        Self::enter(run_id, max_actors, Participant::Client)
    }

    fn enter(run_id: &str, max_actors: u32, participant: Participant) -> Result<Self, DomainError> {
        let root = user_root()?;
        let directory = root.join(run_id);
        // Held until the node exists, so that a process that removes abandoned runs does not remove this one.
        let lock = make_and_lock(&directory)?;
        let user_root = File::open(&root).map_err(io_error("open", &root))?;
        let membership = match participant {
            Participant::Client => None,
            Participant::Member => {
                Some(Membership::enter(run_id).map_err(io_error("lock a file in", Path::new(SHARED_MEMORY)))?)
            }
        };
        let failed = |cause: String| DomainError::SharedMemory {
            action: "join",
            run_id: run_id.into(),
            cause,
        };
        let config = iox_config(&root, run_id).map_err(failed)?;
        let name = NodeName::new(participant.node_name()).map_err(|cause| failed(format!("{cause:?}")))?;
        let node = NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<ipc::Service>()
            .map_err(|cause| failed(format!("{cause:?}")))?;
        close_to_others(run_id)?;
        let root = lock.metadata().map_err(io_error("inspect", &directory))?;
        Ok(Self {
            node,
            membership,
            // Only the program that tidies up holds an exclusive lock, for a moment.
            _user_root: user_root.try_lock_shared().is_ok().then_some(user_root),
            root: (root.dev(), root.ino()),
            run_id: run_id.into(),
            max_actors: max_actors as usize,
        })
    }

    /// The run's name in shared memory.
    pub fn run_id(&self) -> &str {
        &self.run_id
    }

    /// The most actors that the run's channels are sized for.
    pub fn max_actors(&self) -> usize {
        self.max_actors
    }

    /// The directory of the run's files outside `/dev/shm`. It is removed with the run, and so are all files in it.
    ///
    /// # Errors
    /// When the user's directory cannot be used.
    pub fn directory(&self) -> Result<PathBuf, DomainError> {
        Self::directory_of(&self.run_id)
    }

    /// The directory of the run `run_id`, for a process that has not joined it. Its path is short and has only plain
    /// characters, wherever the run's own directory is: iceoryx2 refuses to read other paths, and paths of more than
    /// 255 bytes.
    ///
    /// # Errors
    /// When the user's directory cannot be used.
    pub fn directory_of(run_id: &str) -> Result<PathBuf, DomainError> {
        Ok(user_root()?.join(run_id))
    }

    /// Records that this run may take this many bytes of shared memory, so that
    /// [`free_shared_memory`](super::free_shared_memory) does not offer them to the user's other runs.
    ///
    /// # Errors
    /// When the record cannot be created.
    pub fn reserve_memory(&self, bytes: u64) -> Result<(), DomainError> {
        memory::reserve_memory(&self.run_id, bytes)
            .map_err(io_error("record the run's needs in", Path::new(SHARED_MEMORY)))
    }

    /// The text of a configuration file with which other iceoryx2 programs find this run.
    ///
    /// # Errors
    /// When iceoryx2's configuration cannot be written as TOML.
    pub fn iox_config(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self.node.config())
    }

    pub(super) fn node(&self) -> &Node<ipc::Service> {
        &self.node
    }

    /// Whether the run's files outside `/dev/shm` still exist, including the files of `services` services. Without them
    /// the processes of the run no longer find each other. What cannot be inspected, as when too many files are open,
    /// counts as existing.
    pub fn is_intact(&self, services: usize) -> bool {
        let Ok(directory) = self.directory() else {
            return true;
        };
        let node = directory.join("nodes").join(self.node.id().value().to_string());
        let details = node.join(format!("{}node.details", prefix(&self.run_id)));
        let same = match std::fs::metadata(&directory) {
            Ok(now) => (now.dev(), now.ino()) == self.root,
            Err(error) => !is_missing(&error),
        };
        // Before the first service, its directory does not exist.
        let has_services = services == 0
            || match std::fs::read_dir(directory.join("services")) {
                Ok(listed) => listed.count() >= services,
                Err(error) => !is_missing(&error),
            };
        same && has_services && std::fs::metadata(details).map_or_else(|error| !is_missing(&error), |_| true)
    }

    /// Whether this is still the shared memory that this process has joined. A client may stay while the run ends, and
    /// even begins again: the run does not wait for it.
    pub(super) fn is_current(&self) -> bool {
        self.is_intact(0)
    }

    /// Makes ports of a client by calling `make`, under the run's lock. Returns `None` if the shared memory that this
    /// process joined was removed: the run may have begun again with services of the same names, and nobody would free
    /// the ports there after this process's death.
    ///
    /// # Errors
    /// When another process holds the lock for too long, or the lock cannot be used.
    pub(super) fn make_ports<Ports>(&self, make: impl FnOnce() -> Ports) -> Result<Option<Ports>, DomainError> {
        // Files are removed only under this lock.
        let Some(_lock) = self.lock_as_client()? else {
            return Ok(None);
        };
        Ok(self.is_current().then(make))
    }

    /// Drops the ports of a client. With the last port of a service, iceoryx2 removes the service's files by their
    /// names, which are the same when the run has begun again. So ports of shared memory that was removed are leaked.
    pub(super) fn drop_ports<Ports>(&self, ports: Ports) {
        let lock = self.lock_as_client();
        if matches!(lock, Ok(Some(_))) && self.is_current() {
            drop(ports);
        } else {
            std::mem::forget(ports);
        }
    }

    /// Takes the run's lock; `None` if there is no such run.
    fn lock_as_client(&self) -> Result<Option<File>, DomainError> {
        lock_within(&self.directory()?, CLIENT_LOCK_TIMEOUT)
    }

    /// Whether a process of the run is alive, even if iceoryx2 does not find it. Clients are not counted.
    pub fn has_members(&self) -> bool {
        matches!(membership::claim(&self.run_id), Ok(Claim::Held))
    }

    /// Leaves the run. The last process to leave removes all files of the run from shared memory, even if the launcher
    /// was killed.
    ///
    /// # Errors
    /// When files cannot be removed.
    pub fn leave(self) -> Result<(), DomainError> {
        let Self {
            node,
            membership,
            run_id,
            ..
        } = self;
        drop(node);
        if let Some(membership) = membership {
            membership.leave();
        }
        let root = user_root()?;
        // It is created again if it is gone: another program may have removed it, but not the files in shared memory.
        let _lock = make_and_lock(&root.join(&run_id))?;
        remove_if_dead(&root, &run_id)
    }

    /// Waits until the processes of an earlier, killed launcher have left the run `run_id`: they end by themselves. The
    /// caller must hold the lock of the run directory.
    ///
    /// # Errors
    /// When some are still alive after `timeout`, for example because they are stopped.
    pub fn wait_for_earlier_processes(run_id: &str, timeout: Duration) -> Result<(), DomainError> {
        let root = user_root()?;
        let deadline = Instant::now() + timeout;
        loop {
            let (mut left, is_free) = {
                let _lock = lock(&root.join(run_id))?;
                let is_free = matches!(claim(run_id)?, Claim::Free { .. });
                (living_processes(&root, run_id)?, is_free)
            };
            if left.is_empty() && is_free {
                return Ok(());
            }
            if Instant::now() >= deadline {
                if left.is_empty() {
                    left = membership::members(run_id);
                }
                return Err(DomainError::StillAlive {
                    run_id: run_id.into(),
                    pids: left,
                });
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Removes the files of this user's runs that no longer have a living process. What cannot be inspected or removed
    /// for the moment is left to the next call: it is not an error of the run that is about to start.
    ///
    /// # Errors
    /// When the user's directory or `/dev/shm` cannot be read.
    pub fn remove_abandoned() -> Result<(), DomainError> {
        let root = user_root()?;
        let listing = std::fs::read_dir(&root).map_err(io_error("list", &root))?;
        for entry in listing.flatten().filter(|entry| entry.path().is_dir()) {
            if let Some(run_id) = entry.file_name().to_str() {
                leave_to_the_next(run_id, remove_if_unlocked(&root, run_id));
            }
        }
        // Runs whose directory another program has removed.
        let runs = membership::runs().map_err(io_error("list", Path::new(SHARED_MEMORY)))?;
        for run_id in runs.iter().filter(|run_id| !root.join(run_id).exists()) {
            leave_to_the_next(run_id, remove_without_directory(&root, run_id));
        }
        Ok(())
    }
}

fn leave_to_the_next(run_id: &str, removed: Result<(), DomainError>) {
    if let Err(error) = removed {
        tracing::debug!("what is left of run {run_id} was not removed: {error}");
    }
}

fn remove_if_unlocked(root: &Path, run_id: &str) -> Result<(), DomainError> {
    match try_lock(&root.join(run_id))? {
        Attempt::Locked(_lock) => remove_if_dead(root, run_id),
        // A held lock shows that a process of the run is alive.
        Attempt::Held | Attempt::Absent => Ok(()),
    }
}

fn remove_without_directory(root: &Path, run_id: &str) -> Result<(), DomainError> {
    if matches!(claim(run_id)?, Claim::Free { .. }) {
        let _lock = make_and_lock(&root.join(run_id))?;
        remove_if_dead(root, run_id)?;
    }
    Ok(())
}

fn is_missing(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory)
}

fn claim(run_id: &str) -> Result<Claim, DomainError> {
    membership::claim(run_id).map_err(io_error("lock a file in", Path::new(SHARED_MEMORY)))
}

/// Makes the file that counts the run's nodes private: iceoryx2 makes it accessible to everybody, whatever the umask.
fn close_to_others(run_id: &str) -> Result<(), DomainError> {
    for (path, _) in files_of(run_id).map_err(io_error("list", Path::new(SHARED_MEMORY)))? {
        if path.extension().is_some_and(|extension| extension == "global_mgmt") {
            std::fs::set_permissions(&path, Permissions::from_mode(0o600))
                .map_err(io_error("restrict the permissions of", &path))?;
        }
    }
    Ok(())
}

pub(super) fn iox_config(root: &Path, run_id: &str) -> Result<Config, String> {
    let directory = root.join(run_id);
    let root_path = IoxPath::new(directory.as_os_str().as_encoded_bytes()).map_err(|e| format!("{e:?}"))?;
    let mut config = Config::default();
    // Only the launcher cleans up after dead processes: it first restores the port tags that iceoryx2 0.10 needs and
    // that are missing when an earlier clean-up was killed (`cleanup.rs`).
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    config.global.set_root_path(&root_path);
    config.global.prefix = FileName::new(prefix(run_id).as_bytes()).map_err(|e| format!("{e:?}"))?;
    Ok(config)
}

/// Process ids of the living processes of the run, including stopped ones but not clients.
fn living_processes(root: &Path, run_id: &str) -> Result<Vec<i32>, DomainError> {
    let failed = |cause: String| DomainError::SharedMemory {
        action: "list the processes of",
        run_id: run_id.into(),
        cause,
    };
    let config = iox_config(root, run_id).map_err(failed)?;
    let mut living = Vec::new();
    Node::<ipc::Service>::list(&config, |state| {
        let pid = state.node_id().pid::<ipc::Service>().map_or(0, |pid| pid.value());
        let is_alive = match state {
            NodeState::Dead(_) => false,
            NodeState::Alive(node) => {
                let name = node.details().as_ref().map(|details| details.name().as_str());
                name != Some(Participant::Client.node_name())
            }
            // For example, a process that was killed while it joined.
            NodeState::Inaccessible(_) | NodeState::Undefined(_) => {
                rustix::process::Pid::from_raw(pid).is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok())
            }
        };
        if is_alive {
            living.push(pid);
        }
        CallbackProgression::Continue
    })
    .map_err(|cause| failed(format!("{cause:?}")))?;
    Ok(living)
}

fn remove_if_dead(root: &Path, run_id: &str) -> Result<(), DomainError> {
    if !living_processes(root, run_id)?.is_empty() {
        return Ok(());
    }
    // If another program has removed files of the run, iceoryx2 lists no processes, but they are still members.
    let claim = claim(run_id)?;
    if matches!(claim, Claim::Held) {
        return Ok(());
    }
    // The files are unused: no process of the run is left, and no other run has its name. iceoryx2 itself never removes
    // the file that counts its nodes.
    for (path, _) in files_of(run_id).map_err(io_error("list", Path::new(SHARED_MEMORY)))? {
        remove(&path, |path| std::fs::remove_file(path))?;
    }
    remove(&root.join(run_id), |path| std::fs::remove_dir_all(path))
}

fn remove(path: &Path, how: impl Fn(&Path) -> io::Result<()>) -> Result<(), DomainError> {
    match how(path) {
        Err(cause) if cause.kind() != io::ErrorKind::NotFound => Err(io_error("remove", path)(cause)),
        _ => Ok(()),
    }
}

/// `/tmp/shoal-<user id>`, accessible to its owner alone.
pub(super) fn user_root() -> Result<PathBuf, DomainError> {
    let user = rustix::process::getuid().as_raw();
    let root = PathBuf::from(format!("/tmp/shoal-{user}"));
    match DirBuilder::new().mode(0o700).create(&root) {
        Err(cause) if cause.kind() != io::ErrorKind::AlreadyExists => return Err(io_error("make", &root)(cause)),
        _ => {}
    }
    let metadata = std::fs::symlink_metadata(&root).map_err(io_error("inspect", &root))?;
    if !metadata.is_dir() || metadata.uid() != user {
        return Err(DomainError::Foreign(root));
    }
    Ok(root)
}

/// The most processes that use an event service or a channel of reports at the same time.
pub(super) fn participants(max_actors: usize) -> usize {
    2 * max_actors + 8
}

/// The result of an attempt to take a run's lock.
enum Attempt {
    Locked(File),
    /// Another process holds it.
    Held,
    /// The run does not exist.
    Absent,
}

/// Takes the lock of the run in this directory; `None` if there is no such run.
fn lock(directory: &Path) -> Result<Option<File>, DomainError> {
    lock_within(directory, LOCK_TIMEOUT)
}

fn lock_within(directory: &Path, timeout: Duration) -> Result<Option<File>, DomainError> {
    let deadline = Instant::now() + timeout;
    loop {
        match try_lock(directory)? {
            Attempt::Locked(lock) => return Ok(Some(lock)),
            Attempt::Absent => return Ok(None),
            Attempt::Held if Instant::now() < deadline => std::thread::sleep(Duration::from_millis(1)),
            Attempt::Held => return Err(DomainError::Locked(directory.into())),
        }
    }
}

/// Takes the lock of the run in this directory, and creates the run if it does not exist.
fn make_and_lock(directory: &Path) -> Result<File, DomainError> {
    loop {
        match DirBuilder::new().mode(0o700).create(directory) {
            Err(cause) if cause.kind() != io::ErrorKind::AlreadyExists => {
                return Err(io_error("make", directory)(cause));
            }
            _ => {}
        }
        // The last process of an earlier run may have removed the directory in between.
        if let Some(lock) = lock(directory)? {
            return Ok(lock);
        }
    }
}

fn try_lock(directory: &Path) -> Result<Attempt, DomainError> {
    loop {
        let file = match File::open(directory) {
            Err(cause) if cause.kind() == io::ErrorKind::NotFound => return Ok(Attempt::Absent),
            opened => opened.map_err(io_error("open", directory))?,
        };
        if !file_lock::lock(&file, Duration::ZERO).map_err(io_error("lock", directory))? {
            return Ok(Attempt::Held);
        }
        // The previous holder may have removed the directory, and another one may have been created.
        let inode = |metadata: io::Result<Metadata>| metadata.ok().map(|metadata| metadata.ino());
        if inode(file.metadata()) == inode(directory.metadata()) {
            return Ok(Attempt::Locked(file));
        }
    }
}

pub(super) fn io_error(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> DomainError {
    let path = path.to_owned();
    move |cause| DomainError::Io { action, path, cause }
}
