//! How a role learns that it shall end. Its standard input closes when the launcher wants it or is no more: one sign for
//! both, and the system gives it even when the launcher is killed. A role that is still there some time after that, stuck in
//! a call that does not return, is ended by the thread that watches. A line on standard input before that lets it retire:
//! the run goes on, and it may take the time to hand over all it has.

use std::io::{ErrorKind, Read};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use rustix::process::{Signal, getpgrp, getpid, kill_process, kill_process_group};

/// How long a role may take to end after its standard input has closed. The launcher gives it no longer either.
pub const GRACE: Duration = Duration::from_secs(15);

const RETIRE: u8 = 1;
const END: u8 = 2;

/// The wish to end; every loop of a role looks at it.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicU8>);

impl Stop {
    /// A stop that is requested once this process's standard input says or ends something. [`GRACE`] after its end the
    /// process is killed, if it is still there, and with it those of its process group, if it leads one.
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
            std::thread::sleep(GRACE);
            kill_this_group();
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

/// Ends this process, and with it those of its process group where it leads one.
fn kill_this_group() {
    // Neither fails: the process is there, and its own.
    let _ = if getpgrp() == getpid() {
        kill_process_group(getpgrp(), Signal::KILL)
    } else {
        kill_process(getpid(), Signal::KILL)
    };
}
