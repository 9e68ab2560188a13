//! The signals that end this program in order.

use std::io::{self, Read};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::net::UnixStream;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, LazyLock, Mutex, PoisonError};
use std::time::Duration;

use anyhow::Context;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};

use crate::child_process::wait_for_any;

/// Tells whether a signal to end this process has arrived. The default never receives one.
#[derive(Clone, Debug, Default)]
pub struct Interrupt(Arc<AtomicUsize>);

impl Interrupt {
    /// The last signal that has arrived.
    pub fn signal(&self) -> Option<i32> {
        match self.0.load(Ordering::Relaxed) {
            0 => None,
            signal => Some(signal as i32),
        }
    }
}

/// How many `Signals` there are in this process. While there is one, none of the signals ends the process.
static RECEIVERS: Mutex<usize> = Mutex::new(0);

/// Whether there is none.
static HAS_NO_RECEIVER: LazyLock<Arc<AtomicBool>> = LazyLock::new(Arc::default);

/// Changes the number of receivers.
fn change_receivers(change: impl FnOnce(usize) -> usize) {
    let mut receivers = RECEIVERS.lock().unwrap_or_else(PoisonError::into_inner);
    *receivers = change(*receivers);
    HAS_NO_RECEIVER.store(*receivers == 0, Ordering::Relaxed);
}

/// Receives SIGINT, SIGTERM and SIGHUP. Once all `Signals` are dropped, these signals end the process again. A signal
/// that was ignored when this process started stays ignored, such as SIGHUP under `nohup`.
#[derive(Debug)]
pub struct Signals {
    last: Arc<AtomicUsize>,
    /// Readable if a signal has arrived since the last call of `received`.
    wake: UnixStream,
}

impl Signals {
    /// Starts to receive the signals.
    ///
    /// # Errors
    /// When a handler cannot be registered.
    pub fn register() -> anyhow::Result<Self> {
        let registered = || -> io::Result<Self> {
            let last = Arc::default();
            let (wake, write) = UnixStream::pair()?;
            wake.set_nonblocking(true)?;
            let ignored = ignored_signals();
            for signal in [SIGINT, SIGTERM, SIGHUP] {
                if is_in(ignored, signal) {
                    continue;
                }
                // In this order, so that a thread that is woken finds the number.
                signal_hook::flag::register_conditional_default(signal, Arc::clone(&HAS_NO_RECEIVER))?;
                signal_hook::flag::register_usize(signal, Arc::clone(&last), signal as usize)?;
                signal_hook::low_level::pipe::register(signal, write.try_clone()?)?;
            }
            Ok(Self { last, wake })
        };
        // Before the first handler is registered: a handler that an earlier receiver has left must not end the process.
        change_receivers(|receivers| receivers + 1);
        let signals = registered().inspect_err(|_| change_receivers(|receivers| receivers - 1));
        signals.context("cannot watch for signals")
    }

    /// The last signal that has arrived.
    pub fn received(&self) -> Option<i32> {
        // Empties the stream, so that each signal wakes only once.
        let _ = (&self.wake).read(&mut [0; 64]);
        self.interrupt().signal()
    }

    /// A handle with which other code learns of the signals without waiting for them.
    pub fn interrupt(&self) -> Interrupt {
        Interrupt(Arc::clone(&self.last))
    }

    /// Waits at most `timeout` for a signal. Returns the last signal that has arrived, if any.
    pub fn wait(&self, timeout: Duration) -> Option<i32> {
        if self.last.load(Ordering::Relaxed) == 0 {
            wait_for_any(&[self.as_fd()], timeout);
        }
        self.received()
    }
}

impl AsFd for Signals {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.wake.as_fd()
    }
}

impl Drop for Signals {
    fn drop(&mut self) {
        change_receivers(|receivers| receivers - 1);
    }
}

/// The signals that this process ignores, a bit for each; none where the system does not say.
fn ignored_signals() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .unwrap_or(0)
}

fn is_in(mask: u64, signal: i32) -> bool {
    // Signals count from 1, bits from 0.
    mask >> (signal - 1) & 1 == 1
}

/// The signal's number and name, as in `signal 15 (SIGTERM)`.
pub fn describe(signal: i32) -> String {
    match signal_hook::low_level::signal_name(signal) {
        Some(name) => format!("signal {signal} ({name})"),
        None => format!("signal {signal}"),
    }
}

/// The exit code with which a shell reports that a signal ended a process.
pub fn exit_code(signal: i32) -> std::process::ExitCode {
    std::process::ExitCode::from(128 + signal as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::event::PollFlags;

    #[test]
    fn the_mask_of_ignored_signals_is_read_bit_by_bit() {
        let mask = 1 << (SIGHUP - 1) | 1 << (SIGINT - 1);
        assert_eq!(
            [SIGHUP, SIGINT, SIGTERM].map(|signal| is_in(mask, signal)),
            [true, true, false]
        );
        // The runtime of every Rust program ignores this one.
        assert!(is_in(ignored_signals(), signal_hook::consts::SIGPIPE));
    }

    #[test]
    fn a_signal_wakes_a_waiting_thread_and_is_remembered() {
        // Receivers that have been dropped do not count.
        drop(Signals::register().unwrap());
        let signals = Signals::register().unwrap();
        drop(Signals::register().unwrap());
        assert_eq!(signals.received(), None);
        assert_eq!(signals.wait(Duration::from_millis(1)), None);
        std::thread::scope(|scope| {
            scope.spawn(|| signal_hook::low_level::raise(SIGTERM).unwrap());
            assert_eq!(signals.wait(Duration::from_secs(60)), Some(SIGTERM));
        });
        assert_eq!(signals.received(), Some(SIGTERM));
        // It has been received, so it does not wake a poll again.
        let mut ready = [rustix::event::PollFd::new(&signals, PollFlags::IN)];
        assert_eq!(rustix::event::poll(&mut ready, Some(&Default::default())), Ok(0));
    }
}
