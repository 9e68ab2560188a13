//! Advisory locks on open files. The system releases them when the processes that have the file open end.

use std::fs::{File, Metadata, TryLockError};
use std::io;
use std::os::unix::fs::MetadataExt;
use std::thread;
use std::time::{Duration, Instant};

/// Pause between two attempts to take a lock that another process holds.
const RETRY_INTERVAL: Duration = Duration::from_millis(1);

/// How long to wait for a lock that should be free. A process that checks it holds it for a moment; a killed process
/// holds it until the system has closed its files.
pub const RELEASE_TIMEOUT: Duration = Duration::from_millis(200);

/// Locks the file exclusively, waiting at most `timeout`. Returns whether it is locked now.
///
/// # Errors
/// When the system refuses for another reason than a lock of another process.
pub fn lock(file: &File, timeout: Duration) -> io::Result<bool> {
    let deadline = Instant::now() + timeout;
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(true),
            Err(TryLockError::Error(cause)) => return Err(cause),
            Err(TryLockError::WouldBlock) if Instant::now() >= deadline => return Ok(false),
            Err(TryLockError::WouldBlock) => thread::sleep(RETRY_INTERVAL),
        }
    }
}

/// Whether a process holds an exclusive lock on the file. The check itself takes a shared lock for a moment.
///
/// # Errors
/// When the lock's state cannot be determined.
pub fn is_locked(file: &File) -> io::Result<bool> {
    match file.try_lock_shared() {
        Ok(()) => Ok(false),
        Err(TryLockError::WouldBlock) => Ok(true),
        Err(TryLockError::Error(cause)) => Err(cause),
    }
}

/// The ids of the processes that hold a lock on the file with this metadata, by `/proc/locks`. Empty on file systems
/// for which that file shows other inodes.
pub fn holders(file: &Metadata) -> Vec<i32> {
    let locks = std::fs::read_to_string("/proc/locks").unwrap_or_default();
    locks.lines().filter_map(|line| holder(line, file.ino())).collect()
}

/// The process that holds the lock in this line of `/proc/locks`, as in `1: FLOCK  ADVISORY  WRITE 4711 08:01:1234 0
/// EOF`, if it is one on the file with this inode. A process of another PID namespace has the id 0 or -1.
fn holder(line: &str, inode: u64) -> Option<i32> {
    let words: Vec<_> = line.split_whitespace().collect();
    // A process that waits for a lock has an arrow before its kind.
    let [_, "FLOCK", _, _, pid, file, ..] = words[..] else {
        return None;
    };
    let found: u64 = file.rsplit(':').next()?.parse().ok()?;
    pid.parse().ok().filter(|pid| *pid > 0 && found == inode)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_excludes_others_until_its_file_is_closed() {
        // Some other file systems show other inodes in /proc/locks.
        let directory = tempfile::tempdir_in("/dev/shm").unwrap();
        let open = || File::open(directory.path()).unwrap();
        let first = open();
        assert!(lock(&first, Duration::ZERO).unwrap());
        assert!(!lock(&open(), Duration::from_millis(5)).unwrap());
        assert!(is_locked(&open()).unwrap());
        assert_eq!(
            holders(&directory.path().metadata().unwrap()),
            [std::process::id() as i32]
        );
        let second = open();
        thread::scope(|scope| {
            scope.spawn(|| {
                thread::sleep(Duration::from_millis(20));
                drop(first);
            });
            assert!(lock(&second, Duration::from_secs(60)).unwrap());
        });
        drop(second);
        assert!(holders(&directory.path().metadata().unwrap()).is_empty());
        assert!(!is_locked(&open()).unwrap());
    }

    #[test]
    fn a_line_names_the_holder_of_a_lock() {
        let line = "1: FLOCK  ADVISORY  WRITE 4711 08:01:1234 0 EOF";
        assert_eq!(holder(line, 1234), Some(4711));
        assert_eq!(holder(line, 123), None, "another file");
        for other in [
            "1: -> FLOCK  ADVISORY  WRITE 4711 08:01:1234 0 EOF",
            "1: POSIX  ADVISORY  WRITE 4711 08:01:1234 0 EOF",
            "1: FLOCK  ADVISORY  WRITE 0 08:01:1234 0 EOF",
            "1: FLOCK  ADVISORY  WRITE 4711 08:01:1234x 0 EOF",
            "",
        ] {
            assert_eq!(holder(other, 1234), None, "{other}");
        }
    }
}
