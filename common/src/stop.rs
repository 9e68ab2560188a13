//! How a role learns that it shall end: its standard input closes, because the launcher wants it or because the launcher
//! is no more. One sign for both, and the system gives it even when the launcher is killed.

use std::io::Read;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// The wish to end; every loop of a role looks at it.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicBool>);

impl Stop {
    /// A stop that is requested once this process's standard input has closed.
    ///
    /// # Errors
    /// When the watching thread cannot be started.
    pub fn when_stdin_closes() -> std::io::Result<Self> {
        let stop = Self::default();
        let flag = stop.clone();
        std::thread::Builder::new().name("stdin".into()).spawn(move || {
            let mut ignored = [0; 64];
            let mut stdin = std::io::stdin().lock();
            while !matches!(stdin.read(&mut ignored), Ok(0)) {}
            flag.request();
        })?;
        Ok(stop)
    }

    /// Asks for the end.
    pub fn request(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether the end was asked for.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}
