//! A child process and all it starts: none of its process group outlives it.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStderr, ChildStdin, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, PidfdFlags, Signal, WaitId, WaitIdOptions, kill_process_group, pidfd_open, waitid};

use super::wait_for_any;

/// How long a process may take to be gone that was killed: more only where the kernel waits for a device.
const GONE: Duration = Duration::from_secs(5);

/// A child process that leads a process group. Dropped, it is killed. As a descriptor it is readable once it has ended.
#[derive(Debug)]
pub struct ChildGroup {
    child: Child,
    descriptor: OwnedFd,
    ended: Option<ExitStatus>,
}

impl ChildGroup {
    /// Starts the command, with its standard input and standard error open to this process.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn start(command: &mut Command) -> io::Result<(Self, Option<ChildStdin>, Option<ChildStderr>)> {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // Ctrl-C is for this process, which ends the others in order.
            .process_group(0)
            .spawn()?;
        // Held apart from the child: waiting for a child closes its own.
        let (stdin, stderr) = (child.stdin.take(), child.stderr.take());
        // It has not been waited for, so the number is still its own.
        let descriptor = match pidfd_open(Pid::from_child(&child), PidfdFlags::empty()) {
            Ok(descriptor) => descriptor,
            Err(error) => {
                child.kill()?;
                child.wait()?;
                return Err(error.into());
            }
        };
        let group = Self {
            child,
            descriptor,
            ended: None,
        };
        Ok((group, stdin, stderr))
    }

    /// Its number.
    pub fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// How it ended, if it has. None of its group is left then.
    pub fn exit_status(&mut self) -> Option<ExitStatus> {
        if self.ended.is_none() {
            let look = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
            if let Ok(Some(_)) = waitid(WaitId::Pid(self.pid()), look) {
                // Before it is waited for: its number is not anybody else's yet.
                self.kill();
            }
            self.ended = self.child.try_wait().ok().flatten();
        }
        self.ended
    }

    /// Waits for its end, but no longer than `patience`; how it ended, if it has.
    pub fn wait(&mut self, patience: Duration) -> Option<ExitStatus> {
        let deadline = Instant::now() + patience;
        loop {
            let status = self.exit_status();
            let left = deadline.saturating_duration_since(Instant::now());
            if status.is_some() || left.is_zero() {
                return status;
            }
            wait_for_any(&[self.as_fd()], left);
        }
    }

    /// Whether its end is still to be seen.
    pub fn is_alive(&self) -> bool {
        self.ended.is_none()
    }

    /// Ends it and its group without asking.
    pub fn kill(&mut self) {
        if self.ended.is_none() {
            // It has not been waited for, so the group is there, if only with a dead process in it.
            let _ = kill_process_group(self.pid(), Signal::KILL);
        }
    }
}

impl Drop for ChildGroup {
    fn drop(&mut self) {
        self.kill();
        self.wait(GONE);
    }
}

impl AsFd for ChildGroup {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.descriptor.as_fd()
    }
}
