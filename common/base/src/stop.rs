//! How a role learns that it must end.
//!
//! A role's standard input closes when the launcher asks it to end, and also when the launcher dies, because the system
//! closes the pipe. If the role is still there some time later, stuck in a call that does not return, the thread that
//! watches standard input kills it. A line on standard input asks the role to retire: the run continues without it, and
//! it may take as long as it needs to hand over what it has.

use std::io::{ErrorKind, Read};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use rustix::process::{Signal, getpgrp, getpid, kill_process, kill_process_group};

/// How long a role may take to end after its standard input has closed. After that, a thread of its own kills it. A
/// living launcher waits no longer than this before it kills the role itself.
pub const GRACE: Duration = Duration::from_secs(15);

const RETIRE: u8 = 1;
const END: u8 = 2;

/// The request to end, which every loop of a role checks.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<AtomicU8>);

impl Stop {
    /// A stop that is requested when this process's standard input receives a line or closes. [`GRACE`] after it
    /// closed, the process is killed if it still runs, together with its process group if it leads one.
    ///
    /// # Errors
    /// When the thread that watches standard input cannot be started.
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

    /// Requests the end.
    pub fn request(&self) {
        self.raise(END);
    }

    /// Whether the role was asked to end, with the run or alone.
    pub fn requested(&self) -> bool {
        self.0.load(Ordering::Relaxed) > 0
    }

    /// Whether the whole run is ending, so that the role must not wait for long.
    pub fn run_is_ending(&self) -> bool {
        self.0.load(Ordering::Relaxed) >= END
    }

    fn raise(&self, request: u8) {
        self.0.fetch_max(request, Ordering::Relaxed);
    }
}

/// Kills this process, together with its process group if it leads one. Does not return.
pub fn kill_this_group() -> ! {
    // This cannot fail: the process exists and belongs to the same user.
    let _ = if getpgrp() == getpid() {
        kill_process_group(getpgrp(), Signal::KILL)
    } else {
        kill_process(getpid(), Signal::KILL)
    };
    // The signal has ended this process before the call returns.
    std::process::abort()
}
