//! Shows that processes of a run are alive, whatever happens to the run's files below `/tmp`: other programs may tidy
//! that directory up. Every process of a run, except clients, holds a shared lock on `shoal_<run>_members` in shared
//! memory. The run's other files there may be removed only by a process that holds the lock exclusively.

use std::fs::{File, OpenOptions, TryLockError};
use std::io;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::PathBuf;
use std::thread;
use std::time::{Duration, Instant};

use shoal_base::file_lock;

use super::files::{SHARED_MEMORY, prefix};

/// The end of the file's name.
const MEMBERS: &str = "members";

/// How long to wait for a process that removes the files of an earlier run with this name. It takes some milliseconds.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Shows that this process is a member of a run.
#[derive(Debug)]
pub(super) struct Membership(Option<File>);

/// Whether this process may remove a run's files.
#[derive(Debug)]
pub(super) enum Claim {
    /// No member is alive, and none can join before this is dropped: it holds the lock.
    Free { _lock: Option<File> },
    /// Processes of the run are alive.
    Held,
}

impl Membership {
    /// Becomes a member. If another user owns a file of this name, the process joins without a lock, and its membership
    /// cannot be seen.
    ///
    /// # Errors
    /// When the file cannot be made or locked.
    pub(super) fn enter(run_id: &str) -> io::Result<Self> {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            let Some(file) = open(run_id, true)? else {
                return Ok(Self(None));
            };
            match file.try_lock_shared() {
                // Otherwise it was removed in between.
                Ok(()) if is_current(run_id, &file) => return Ok(Self(Some(file))),
                Err(TryLockError::Error(cause)) => return Err(cause),
                _ if Instant::now() >= deadline => return Err(io::ErrorKind::TimedOut.into()),
                _ => thread::sleep(Duration::from_millis(1)),
            }
        }
    }

    /// Stops being a member, even if a child process that is just being started has the file open too.
    pub(super) fn leave(self) {
        // This fails only if it is not locked.
        let _ = self.0.as_ref().map(File::unlock);
    }
}

/// Claims the run's files for removal.
///
/// # Errors
/// When the lock's state cannot be determined.
pub(super) fn claim(run_id: &str) -> io::Result<Claim> {
    loop {
        let Some(file) = open(run_id, false)? else {
            return Ok(Claim::Free { _lock: None });
        };
        match file.try_lock() {
            Ok(()) if is_current(run_id, &file) => return Ok(Claim::Free { _lock: Some(file) }),
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Ok(Claim::Held),
            Err(TryLockError::Error(cause)) => return Err(cause),
        }
    }
}

/// The process ids of the run's members, as far as the system tells them.
pub(super) fn members(run_id: &str) -> Vec<i32> {
    let Ok(metadata) = path(run_id).symlink_metadata() else {
        return Vec::new();
    };
    file_lock::holders(&metadata)
}

/// The runs of this user that have such a file.
pub(super) fn runs() -> io::Result<Vec<String>> {
    let user = rustix::process::getuid().as_raw();
    let run_of = |entry: std::fs::DirEntry| {
        let name = entry.file_name().into_string().ok()?;
        let run_id = name.strip_prefix("shoal_")?.strip_suffix(MEMBERS)?.strip_suffix('_')?;
        let ours = entry.metadata().ok()?.uid() == user;
        (ours && !run_id.is_empty()).then(|| run_id.to_owned())
    };
    Ok(std::fs::read_dir(SHARED_MEMORY)?.flatten().filter_map(run_of).collect())
}

/// Whether this is the name of such a file.
pub(super) fn is_members_file(name: &str) -> bool {
    name.ends_with(&format!("_{MEMBERS}"))
}

fn path(run_id: &str) -> PathBuf {
    PathBuf::from(SHARED_MEMORY).join(format!("{}{MEMBERS}", prefix(run_id)))
}

/// Opens the file, and makes it if asked to; `None` if there is none, or it is another user's.
fn open(run_id: &str, make: bool) -> io::Result<Option<File>> {
    let mut options = OpenOptions::new();
    options
        .read(true)
        .write(true)
        .create(make)
        .truncate(false)
        .mode(0o600)
        .custom_flags(rustix::fs::OFlags::NOFOLLOW.bits() as i32);
    match options.open(path(run_id)) {
        Err(cause) if matches!(cause.kind(), io::ErrorKind::NotFound | io::ErrorKind::PermissionDenied) => Ok(None),
        Err(cause) => Err(cause),
        Ok(file) => {
            let ours = file.metadata()?.uid() == rustix::process::getuid().as_raw();
            Ok(Some(file).filter(|_| ours))
        }
    }
}

/// Whether the run's file is still this one.
fn is_current(run_id: &str, file: &File) -> bool {
    let number = |metadata: io::Result<std::fs::Metadata>| metadata.ok().map(|metadata| metadata.ino());
    number(path(run_id).symlink_metadata()) == number(file.metadata())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_free_once_all_its_members_have_left() {
        let run_id = format!("pr{:x}", std::process::id());
        assert!(matches!(claim(&run_id).unwrap(), Claim::Free { _lock: None }));
        let (first, second) = (Membership::enter(&run_id).unwrap(), Membership::enter(&run_id).unwrap());
        assert!(runs().unwrap().contains(&run_id) && is_members_file(&path(&run_id).to_string_lossy()));
        assert!(members(&run_id).contains(&(std::process::id() as i32)));
        first.leave();
        assert!(matches!(claim(&run_id).unwrap(), Claim::Held));
        second.leave();
        let Claim::Free { _lock: Some(claimed) } = claim(&run_id).unwrap() else {
            panic!("nobody has it");
        };
        std::fs::remove_file(path(&run_id)).unwrap();
        // Whoever joins now makes a new file.
        let third = Membership::enter(&run_id).unwrap();
        drop(claimed);
        assert!(matches!(claim(&run_id).unwrap(), Claim::Held));
        third.leave();
        std::fs::remove_file(path(&run_id)).unwrap();
    }
}
