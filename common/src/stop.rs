//! How a role learns that it shall end. Its standard input closes when the launcher wants it or is no more: one sign for
//! both, and the system gives it even when the launcher is killed. A line on standard input before that lets it retire:
//! the run goes on, and it may take the time to hand over all it has.

use std::io::{ErrorKind, Read};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};

const RETIRE: u8 = 1;
const END: u8 = 2;

/// The wish to end; every loop of a role looks at it.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicU8>);

impl Stop {
    /// A stop that is requested once this process's standard input says or ends something.
    ///
    /// # Errors
    /// When the watching thread cannot be started.
    pub fn when_stdin_closes() -> std::io::Result<Self> {
        let stop = Self::default();
        let flag = stop.clone();
        std::thread::Builder::new().name("stdin".into()).spawn(move || {
            let mut ignored = [0; 64];
            let mut stdin = std::io::stdin().lock();
            loop {
                match stdin.read(&mut ignored) {
                    Ok(0) => break,
                    Ok(_) => flag.raise(RETIRE),
                    Err(error) if error.kind() == ErrorKind::Interrupted => {}
                    Err(_) => break,
                }
            }
            flag.request();
        })?;
        Ok(stop)
    }

    /// Asks for the end.
    pub fn request(&self) {
        self.raise(END);
    }

    /// Whether the end was asked for, at leisure or not.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed) > 0
    }

    /// Whether the run is ending too, so that nobody may wait for long.
    pub fn at_once(&self) -> bool {
        self.0.load(Ordering::Relaxed) >= END
    }

    fn raise(&self, wish: u8) {
        self.0.fetch_max(wish, Ordering::Relaxed);
    }
}
