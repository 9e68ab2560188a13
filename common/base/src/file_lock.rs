//! Locks on open files. They are advisory, and gone with the processes that have the file open.

use std::fs::{File, TryLockError};
use std::io;
use std::thread;
use std::time::{Duration, Instant};

/// How often a lock that another process holds is asked for again.
const PAUSE: Duration = Duration::from_millis(1);

/// Locks the file for this process alone, and waits for that no longer than `patience`; whether it is locked now.
///
/// # Errors
/// When the system refuses for another reason than that somebody holds a lock.
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

/// Whether somebody has locked the file for himself alone. Asking holds a lock for a moment that lets others ask.
///
/// # Errors
/// When the system refuses to tell.
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
    fn a_lock_keeps_others_out_until_its_file_is_closed() {
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
