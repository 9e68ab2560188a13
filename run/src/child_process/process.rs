//! A child process that no launcher manages: a role that is measured, an environment server outside a run, or a whole
//! training.

use std::os::fd::{AsFd, BorrowedFd};
use std::process::{ChildStdin, Command, ExitStatus};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, bail};
use rustix::process::{Pid, Signal, kill_process};
use rustix::thread::{CpuSet, sched_setaffinity};
use shoal_common::role::{Role, RoleInstance};
use shoal_common::run_dir::RunDir;

use crate::child_process::{ChildGroup, ChildOutput, Line, OutputSource, role_command};

/// How long a process may take to end in order. A learner writes its replay to the disk.
const END_TIMEOUT: Duration = Duration::from_secs(15);

/// How long a process whose state does not matter may take to end.
const SHUT_DOWN_TIMEOUT: Duration = Duration::from_secs(2);

/// Exit code of a launcher that SIGTERM has ended in order.
const TERMINATED: i32 = 143;

/// A process that ends when its standard input closes, and therefore also when this process is gone.
#[derive(Debug)]
pub struct ChildProcess {
    group: ChildGroup,
    stdin: Option<ChildStdin>,
    /// Reads what the process writes.
    output: Option<ChildOutput>,
    last_line: Arc<Mutex<Option<String>>>,
    what: String,
}

impl AsFd for ChildProcess {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.group.as_fd()
    }
}

impl ChildProcess {
    /// Starts this program again as the process with index 0 of this role.
    pub fn role(role: Role, run: &RunDir) -> anyhow::Result<Self> {
        let first = RoleInstance {
            role,
            index: 0,
            incarnation: 1,
        };
        Self::of_instance(first, run)
    }

    /// Starts this program again as a role of the run.
    pub fn of_instance(instance: RoleInstance, run: &RunDir) -> anyhow::Result<Self> {
        let name = instance.role.name();
        let mut command = role_command(instance, run.path());
        Self::start(&mut command, name.into()).with_context(|| format!("cannot start the {name}"))
    }

    /// Starts a process; messages name it `what`.
    pub fn start(command: &mut Command, what: String) -> std::io::Result<Self> {
        let (group, stdin, stderr) = ChildGroup::start(command)?;
        let mut process = Self {
            group,
            stdin,
            output: None,
            last_line: Arc::default(),
            what,
        };
        let last_line = Arc::clone(&process.last_line);
        let keep = move |line: Line<'_>| match line {
            Line::Kept(text) | Line::OverLimit(text) if !text.trim().is_empty() => {
                *last_line.lock().unwrap_or_else(PoisonError::into_inner) = Some(text.trim().into());
            }
            _ => {}
        };
        process.output = stderr
            .map(|stderr| ChildOutput::read("child output", stderr, OutputSource::Program, keep))
            .transpose()?;
        Ok(process)
    }

    /// Its process id.
    pub fn pid(&self) -> Pid {
        self.group.pid()
    }

    /// Checks that the process is still running.
    ///
    /// # Errors
    /// When it has ended, with the last line it wrote.
    pub fn check(&mut self) -> anyhow::Result<()> {
        match self.group.exit_status() {
            Some(status) => self.ended_early(status),
            None => Ok(()),
        }
    }

    /// Restricts the process's first thread to these cores, and thereby the threads that it starts later.
    pub fn pin(&self, cores: &CpuSet) -> anyhow::Result<()> {
        sched_setaffinity(Some(self.pid()), cores).with_context(|| format!("cannot pin the {} to a core", self.what))
    }

    /// Pauses the process (SIGSTOP) until [`ChildProcess::resume`].
    pub fn pause(&self) -> anyhow::Result<()> {
        self.signal(Signal::STOP)
    }

    /// Lets a paused process continue.
    pub fn resume(&self) -> anyhow::Result<()> {
        self.signal(Signal::CONT)
    }

    /// Sends the process a signal.
    ///
    /// # Errors
    /// When it cannot be sent.
    pub fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        kill_process(self.pid(), signal).with_context(|| format!("cannot signal the {}", self.what))
    }

    /// Asks the process to end without waiting for it.
    pub fn ask_to_end(&mut self) {
        self.stdin = None;
    }

    /// Asks the process to end, and waits for it.
    pub fn end(mut self) -> anyhow::Result<()> {
        self.ask_to_end();
        match self.await_end(END_TIMEOUT)? {
            status if status.success() => Ok(()),
            status => self.ended_early(status),
        }
    }

    /// Ends a launcher with SIGTERM and waits for it. A launcher does not watch its standard input, and ignores SIGINT
    /// if this process was started in the background of a script.
    pub fn interrupt(mut self, timeout: Duration) -> anyhow::Result<()> {
        self.signal(Signal::TERM)?;
        let status = self.await_end(timeout)?;
        match status.code() {
            Some(0 | TERMINATED) => Ok(()),
            _ => self.ended_early(status),
        }
    }

    /// Waits at most `timeout` for the process to end. Returns its exit status if it has ended.
    pub fn wait(&mut self, timeout: Duration) -> Option<ExitStatus> {
        self.group.wait(timeout)
    }

    fn await_end(&mut self, timeout: Duration) -> anyhow::Result<ExitStatus> {
        let ended = self.group.wait(timeout);
        ended.with_context(|| format!("the {} did not end when asked to", self.what))
    }

    /// Asks the process to end and waits briefly. If it does not end, it is killed on drop.
    pub fn shut_down(&mut self) {
        self.stdin = None;
        self.group.wait(SHUT_DOWN_TIMEOUT);
    }

    fn ended_early(&mut self, status: ExitStatus) -> anyhow::Result<()> {
        let line = self.last_error_line().unwrap_or_else(|| "it wrote no message".into());
        bail!("the {} ended ({status}): {line}", self.what);
    }

    /// The last line that it wrote on standard error, without a leading `error: `, if it wrote any. Waits briefly for
    /// the output of a process that has just ended.
    pub fn last_error_line(&mut self) -> Option<String> {
        if let Some(output) = &self.output {
            output.wait();
        }
        self.last_line()
    }

    /// The last line that it has written on standard error so far. It may take a moment to arrive.
    pub fn last_line(&self) -> Option<String> {
        let line = self.last_line.lock().unwrap_or_else(PoisonError::into_inner).clone()?;
        Some(line.strip_prefix("error: ").unwrap_or(&line).to_owned())
    }
}
