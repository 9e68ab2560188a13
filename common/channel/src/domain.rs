//! A run's own corner of shared memory. Every run has a root directory and a file prefix of its own, below a directory
//! that belongs to one user: two runs never meet, two users neither, and what a killed run left behind is known by name.

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
use super::memory;

/// How long others may have a run's lock: each needs it for some milliseconds.
const LOCK_PATIENCE: Duration = Duration::from_secs(10);

/// The name of processes that are in a run only to ask its launcher something.
const VISITOR: &str = "visitor";

/// Membership of a process in a run: what all its channels are opened through.
#[derive(Debug)]
pub struct Domain {
    node: Node<ipc::Service>,
    run_id: String,
    max_actors: usize,
}

/// A run's corner of shared memory cannot be entered or left.
#[derive(Debug, thiserror::Error)]
pub enum DomainError {
    /// The system refused.
    #[error("cannot {action} {path}: {cause}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// On what.
        path: PathBuf,
        /// The system's reason.
        cause: io::Error,
    },
    /// Somebody else owns the directory that should be ours.
    #[error("{0} belongs to another user; remove it, or ask its owner to")]
    Foreign(PathBuf),
    /// A process has the lock that each holds for a moment only.
    #[error("{0} is locked by another shoal process that does not get on; is one stopped?")]
    Locked(PathBuf),
    /// Processes of the run's last launcher are still there.
    #[error(
        "run {run_id} cannot go on: processes of it are still alive and do not end (stopped?): kill -9 {}",
        pids.iter().map(i32::to_string).collect::<Vec<_>>().join(" ")
    )]
    StillAlive {
        /// The run.
        run_id: String,
        /// Their numbers.
        pids: Vec<i32>,
    },
    /// iceoryx2 refused.
    #[error("cannot join run {run_id} in shared memory: {cause}; is /dev/shm mounted and not full?")]
    Join {
        /// The run.
        run_id: String,
        /// iceoryx2's reason.
        cause: String,
    },
}

impl Domain {
    /// Joins the run `run_id`, whose channels are laid out for up to `max_actors` actors.
    ///
    /// # Errors
    /// When the user's directory cannot be made, or shared memory cannot be had.
    pub fn join(run_id: &str, max_actors: u32) -> Result<Self, DomainError> {
        Self::enter(run_id, max_actors, "")
    }

    /// The same for who only asks the run's launcher something. The run does not wait for its visitors to end.
    ///
    /// # Errors
    /// As [`join`](Self::join).
    pub fn visit(run_id: &str, max_actors: u32) -> Result<Self, DomainError> {
        Self::enter(run_id, max_actors, VISITOR)
    }

    fn enter(run_id: &str, max_actors: u32, name: &str) -> Result<Self, DomainError> {
        let root = user_root()?;
        // Held until the node exists, so that nobody who looks for abandoned runs takes this one for dead.
        let _lock = make_and_lock(&root.join(run_id))?;
        let failed = |cause: String| DomainError::Join {
            run_id: run_id.into(),
            cause,
        };
        let config = iox_config(&root, run_id).map_err(failed)?;
        let name = NodeName::new(name).map_err(|cause| failed(format!("{cause:?}")))?;
        let node = NodeBuilder::new()
            .name(&name)
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<ipc::Service>()
            .map_err(|cause| failed(format!("{cause:?}")))?;
        close_to_others(run_id)?;
        Ok(Self {
            node,
            run_id: run_id.into(),
            max_actors: max_actors as usize,
        })
    }

    /// The run's name in shared memory.
    pub fn run_id(&self) -> &str {
        &self.run_id
    }

    /// The most actors the run's channels have room for.
    pub fn max_actors(&self) -> usize {
        self.max_actors
    }

    /// The directory of the run's files that are not in shared memory. What is put there goes with them.
    ///
    /// # Errors
    /// When the user's directory cannot be used.
    pub fn directory(&self) -> Result<PathBuf, DomainError> {
        Self::directory_of(&self.run_id)
    }

    /// The same of the run `run_id`, for who has not joined it. Its path is short plain text, wherever the run's own
    /// directory is: iceoryx2 refuses to read a file whose path is longer than 255 bytes or has other than plain characters.
    ///
    /// # Errors
    /// When the user's directory cannot be used.
    pub fn directory_of(run_id: &str) -> Result<PathBuf, DomainError> {
        Ok(user_root()?.join(run_id))
    }

    /// Notes that this run may take so many bytes of shared memory, so that
    /// [`free_shared_memory`](super::free_shared_memory) does not offer them to the user's other runs.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn promise(&self, bytes: u64) -> Result<(), DomainError> {
        memory::promise(&self.run_id, bytes).map_err(io_error("note the run's needs in", Path::new(SHARED_MEMORY)))
    }

    /// The text of the configuration file with which other iceoryx2 programs find this run.
    ///
    /// # Errors
    /// When iceoryx2's configuration cannot be written as TOML.
    pub fn iox_config(&self) -> Result<String, toml::ser::Error> {
        toml::to_string(self.node.config())
    }

    pub(super) fn node(&self) -> &Node<ipc::Service> {
        &self.node
    }

    /// Leaves the run. Whoever is the last to leave, be it because the launcher was killed, removes every trace of the run
    /// from shared memory.
    ///
    /// # Errors
    /// When files cannot be removed.
    pub fn leave(self) -> Result<(), DomainError> {
        let run_id = self.run_id.clone();
        drop(self);
        let root = user_root()?;
        // Where the directory is gone, another one was the last, and removed the files before it.
        match lock(&root.join(&run_id))? {
            Some(_lock) => remove_if_dead(&root, &run_id),
            None => Ok(()),
        }
    }

    /// Waits until no process of an earlier launcher is left in the run `run_id`: whose launcher was killed, they are about
    /// to end. Whoever calls this holds the run's lock.
    ///
    /// # Errors
    /// When some are still there after `patience`, as one that is stopped is.
    pub fn wait_for_the_last(run_id: &str, patience: Duration) -> Result<(), DomainError> {
        let root = user_root()?;
        let deadline = Instant::now() + patience;
        loop {
            let left = {
                let _lock = lock(&root.join(run_id))?;
                living(&root, run_id)?
            };
            if left.is_empty() {
                return Ok(());
            }
            if Instant::now() >= deadline {
                return Err(DomainError::StillAlive {
                    run_id: run_id.into(),
                    pids: left,
                });
            }
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Removes what this user's runs left in shared memory that were killed with all their processes.
    ///
    /// # Errors
    /// When the user's directory cannot be read, or files cannot be removed.
    pub fn remove_abandoned() -> Result<(), DomainError> {
        let root = user_root()?;
        let listing = std::fs::read_dir(&root).map_err(io_error("list", &root))?;
        for entry in listing.flatten() {
            if entry.path().is_dir()
                && let Some(run_id) = entry.file_name().to_str()
                // Where somebody has the lock, somebody is there.
                && let Attempt::Locked(_lock) = try_lock(&entry.path())?
            {
                remove_if_dead(&root, run_id)?;
            }
        }
        Ok(())
    }
}

/// Closes the one file that iceoryx2 opens to everybody, whatever the umask: the one that counts the run's nodes.
fn close_to_others(run_id: &str) -> Result<(), DomainError> {
    for (path, _) in files_of(run_id).map_err(io_error("list", Path::new(SHARED_MEMORY)))? {
        if path.extension().is_some_and(|extension| extension == "global_mgmt") {
            std::fs::set_permissions(&path, Permissions::from_mode(0o600)).map_err(io_error("close", &path))?;
        }
    }
    Ok(())
}

pub(super) fn iox_config(root: &Path, run_id: &str) -> Result<Config, String> {
    let directory = root.join(run_id);
    let root_path = IoxPath::new(directory.as_os_str().as_encoded_bytes()).map_err(|e| format!("{e:?}"))?;
    let mut config = Config::default();
    // Cleaning up after the dead is the launcher's, which puts back before what iceoryx2 0.10 misses where an earlier
    // clean-up was killed (`cleanup.rs`).
    config.global.node.cleanup_dead_nodes_on_creation = false;
    config.global.node.cleanup_dead_nodes_on_destruction = false;
    config.global.service.cleanup_dead_nodes_on_open = false;
    config.global.set_root_path(&root_path);
    config.global.prefix = FileName::new(prefix(run_id).as_bytes()).map_err(|e| format!("{e:?}"))?;
    Ok(config)
}

/// Process numbers of those in the run that live, stopped ones included, and visitors not.
fn living(root: &Path, run_id: &str) -> Result<Vec<i32>, DomainError> {
    let failed = |cause: String| DomainError::Join {
        run_id: run_id.into(),
        cause,
    };
    let config = iox_config(root, run_id).map_err(failed)?;
    let mut living = Vec::new();
    Node::<ipc::Service>::list(&config, |state| {
        let pid = state.node_id().pid::<ipc::Service>().map_or(0, |pid| pid.value());
        let lives = match state {
            NodeState::Dead(_) => false,
            NodeState::Alive(node) => {
                let name = node.details().as_ref().map(|details| details.name().as_str());
                name != Some(VISITOR)
            }
            // As one is that was killed while it joined.
            NodeState::Inaccessible(_) | NodeState::Undefined(_) => {
                rustix::process::Pid::from_raw(pid).is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok())
            }
        };
        if lives {
            living.push(pid);
        }
        CallbackProgression::Continue
    })
    .map_err(|cause| failed(format!("{cause:?}")))?;
    Ok(living)
}

fn remove_if_dead(root: &Path, run_id: &str) -> Result<(), DomainError> {
    if !living(root, run_id)?.is_empty() {
        return Ok(());
    }
    // No process of the run is left and its name is its own, so these files are nobody's. iceoryx2 itself never removes
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

/// `/tmp/shoal-<user id>`, closed to everybody else.
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

/// What became of asking for a run's lock.
enum Attempt {
    Locked(File),
    /// Another process has it.
    Held,
    /// Nothing of the run is there.
    Absent,
}

/// The lock of the run in this directory, which no other run has to do with; `None` where there is no such run.
fn lock(directory: &Path) -> Result<Option<File>, DomainError> {
    let deadline = Instant::now() + LOCK_PATIENCE;
    loop {
        match try_lock(directory)? {
            Attempt::Locked(lock) => return Ok(Some(lock)),
            Attempt::Absent => return Ok(None),
            Attempt::Held if Instant::now() < deadline => std::thread::sleep(Duration::from_millis(1)),
            Attempt::Held => return Err(DomainError::Locked(directory.into())),
        }
    }
}

/// The same, of a run that is made where it is not there.
fn make_and_lock(directory: &Path) -> Result<File, DomainError> {
    loop {
        match DirBuilder::new().mode(0o700).create(directory) {
            Err(cause) if cause.kind() != io::ErrorKind::AlreadyExists => {
                return Err(io_error("make", directory)(cause));
            }
            _ => {}
        }
        // The last of an earlier run may remove it at this moment.
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
        // Who had it before may have removed the directory, and another one may be there now.
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
