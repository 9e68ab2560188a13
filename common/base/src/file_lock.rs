//! Advisory locks on open files. The system releases them when the processes that have the file open end.

use std::fs::{File, TryLockError};
use std::io;
use std::thread;
use std::time::{Duration, Instant};

/// Pause between two attempts to take a lock that another process holds.
const PAUSE: Duration = Duration::from_millis(1);

/// Locks the file exclusively, waiting at most `patience`. Returns whether it is locked now.
///
/// # Errors
/// When the system refuses for another reason than a lock of another process.
pub fn lock(file: &File, patience: Duration) -> io::Result<bool> {
    let deadline = Instant::now() + patience;
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(true),
            Err(TryLockError::Error(cause)) => return Err(cause),
            Err(TryLockError::WouldBlock) if Instant::now() >= deadline => return Ok(false),
            Err(TryLockError::WouldBlock) => thread::sleep(PAUSE),
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_excludes_others_until_its_file_is_closed() {
        let directory = tempfile::tempdir().unwrap();
        let open = || File::open(directory.path()).unwrap();
        let first = open();
        assert!(lock(&first, Duration::ZERO).unwrap());
        assert!(!lock(&open(), Duration::from_millis(5)).unwrap());
        assert!(is_locked(&open()).unwrap());
        let second = open();
        thread::scope(|scope| {
            scope.spawn(|| {
                thread::sleep(Duration::from_millis(20));
                drop(first);
            });
            assert!(lock(&second, Duration::from_secs(60)).unwrap());
        });
        drop(second);
        assert!(!is_locked(&open()).unwrap());
    }
}
