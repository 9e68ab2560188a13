//! A child process and everything it starts: no process of its group outlives it.

use std::io;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStderr, ChildStdin, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use rustix::process::{Pid, PidfdFlags, Signal, WaitId, WaitIdOptions, kill_process_group, pidfd_open, waitid};

use super::wait_for_any;

/// How long a killed process may take to disappear. It takes longer only while the kernel waits for a device.
const KILL_TIMEOUT: Duration = Duration::from_secs(5);

/// A child process that leads a process group. It is killed on drop. Its descriptor becomes readable when it has ended.
#[derive(Debug)]
pub struct ChildGroup {
    child: Child,
    descriptor: OwnedFd,
    ended: Option<ExitStatus>,
}

impl ChildGroup {
    /// Starts the command, with its standard input and standard error piped to this process.
    ///
    /// # Errors
    /// When it cannot be started.
    pub fn start(command: &mut Command) -> io::Result<(Self, Option<ChildStdin>, Option<ChildStderr>)> {
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // Ctrl-C reaches only this process, which ends the others in order.
            .process_group(0)
            .spawn()?;
        // Taken out of the child, because waiting for a child closes its standard input.
        let (stdin, stderr) = (child.stdin.take(), child.stderr.take());
        // The child has not been waited for, so its process id is not reused.
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

    /// Its process id.
    pub fn pid(&self) -> Pid {
        Pid::from_child(&self.child)
    }

    /// Its exit status, once it has ended. Its group has been killed by then.
    pub fn exit_status(&mut self) -> Option<ExitStatus> {
        if self.ended.is_none() {
            let look = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
            if let Ok(Some(_)) = waitid(WaitId::Pid(self.pid()), look) {
                // Before it is waited for, so that its process id is not reused yet.
                self.kill();
            }
            self.ended = self.child.try_wait().ok().flatten();
        }
        self.ended
    }

    /// Waits at most `timeout` for the process to end. Returns its exit status if it has ended.
    pub fn wait(&mut self, timeout: Duration) -> Option<ExitStatus> {
        let deadline = Instant::now() + timeout;
        loop {
            let status = self.exit_status();
            let left = deadline.saturating_duration_since(Instant::now());
            if status.is_some() || left.is_zero() {
                return status;
            }
            wait_for_any(&[self.as_fd()], left);
        }
    }

    /// Whether its end has not been observed yet.
    pub fn is_alive(&self) -> bool {
        self.ended.is_none()
    }

    /// Kills it and its group.
    pub fn kill(&mut self) {
        if self.ended.is_none() {
            // It has not been waited for, so the group still exists, if only with a zombie in it.
            let _ = kill_process_group(self.pid(), Signal::KILL);
        }
    }
}

impl Drop for ChildGroup {
    fn drop(&mut self) {
        self.kill();
        self.wait(KILL_TIMEOUT);
    }
}

impl AsFd for ChildGroup {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.descriptor.as_fd()
    }
}
