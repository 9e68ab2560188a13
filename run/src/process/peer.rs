//! Another process that works for this one outside of any run: a role that is measured, an environment server that is asked.

use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::process::CommandExt;
use std::process::{ChildStdin, Command, ExitStatus};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, bail};
use rustix::process::{Pid, Signal, kill_process};
use rustix::thread::{CpuSet, sched_setaffinity};
use shoal_common::report::{Identity, Role};
use shoal_common::run_dir::RunDir;

use crate::process::ChildGroup;
use crate::process::ChildOutput;

/// How long a learner may take to bring its replay to the disk.
const FAREWELL: Duration = Duration::from_secs(15);

/// How long one may take that is not needed any more.
const DISMISSAL: Duration = Duration::from_secs(2);

/// Exit code of a launcher that Ctrl-C has ended in order.
const INTERRUPTED: i32 = 130;

/// A process. It ends when its standard input closes, be it because this process is no more.
#[derive(Debug)]
pub struct Peer {
    group: ChildGroup,
    stdin: Option<ChildStdin>,
    /// What the process writes, and its last line so far.
    output: Option<ChildOutput>,
    last_line: Arc<Mutex<Option<String>>>,
    what: String,
}

impl AsFd for Peer {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.group.as_fd()
    }
}

impl Peer {
    /// Starts this program again as `role` 0 of the run.
    pub fn role(role: Role, run: &RunDir) -> anyhow::Result<Self> {
        let first = Identity {
            role,
            index: 0,
            incarnation: 1,
        };
        Self::member(first, run)
    }

    /// Starts this program again as a role of the run.
    pub fn member(identity: Identity, run: &RunDir) -> anyhow::Result<Self> {
        let Identity {
            role,
            index,
            incarnation,
        } = identity;
        let mut command = Command::new("/proc/self/exe");
        command.arg0("shoal").arg(role.name()).arg(run.path());
        command.args([index.to_string(), incarnation.to_string()]);
        Self::start(&mut command, role.name().into()).with_context(|| format!("cannot start the {}", role.name()))
    }

    /// Starts a process that messages call `what`.
    pub fn start(command: &mut Command, what: String) -> std::io::Result<Self> {
        let (group, stdin, stderr) = ChildGroup::start(command)?;
        let mut peer = Self {
            group,
            stdin,
            output: None,
            last_line: Arc::default(),
            what,
        };
        let last_line = Arc::clone(&peer.last_line);
        let keep = move |line: &str| {
            if !line.trim().is_empty() {
                *last_line.lock().unwrap_or_else(PoisonError::into_inner) = Some(line.trim().into());
            }
        };
        peer.output = stderr
            .map(|stderr| ChildOutput::read("peer", stderr, keep))
            .transpose()?;
        Ok(peer)
    }

    /// Its number.
    pub fn pid(&self) -> Pid {
        self.group.pid()
    }

    /// An error if the process has ended, with what it said last.
    pub fn check(&mut self) -> anyhow::Result<()> {
        match self.group.exit_status() {
            Some(status) => self.ended_early(status),
            None => Ok(()),
        }
    }

    /// Has the process's first thread run on these cores only; threads that it starts later do as well.
    pub fn pin(&self, cores: &CpuSet) -> anyhow::Result<()> {
        sched_setaffinity(Some(self.pid()), cores)
            .with_context(|| format!("cannot choose a core for the {}", self.what))
    }

    /// Stops the process where it is, until [`Peer::go_on`].
    pub fn pause(&self) -> anyhow::Result<()> {
        self.signal(Signal::STOP)
    }

    /// Lets a paused process go on.
    pub fn go_on(&self) -> anyhow::Result<()> {
        self.signal(Signal::CONT)
    }

    /// Sends the process a signal.
    ///
    /// # Errors
    /// When it cannot be reached.
    pub fn signal(&self, signal: Signal) -> anyhow::Result<()> {
        kill_process(self.pid(), signal).with_context(|| format!("cannot signal the {}", self.what))
    }

    /// Asks the process to end, and does not wait for it.
    pub fn ask_to_end(&mut self) {
        self.stdin = None;
    }

    /// Asks the process to end, and waits for it.
    pub fn end(mut self) -> anyhow::Result<()> {
        self.ask_to_end();
        match self.await_end(FAREWELL)? {
            status if status.success() => Ok(()),
            status => self.ended_early(status),
        }
    }

    /// Ends a launcher, which hears signals and not its standard input, and waits for it.
    pub fn interrupt(mut self, patience: Duration) -> anyhow::Result<()> {
        self.signal(Signal::INT)?;
        let status = self.await_end(patience)?;
        match status.code() {
            Some(0 | INTERRUPTED) => Ok(()),
            _ => self.ended_early(status),
        }
    }

    /// Waits for its end, but no longer than `patience`; how it ended, if it has.
    pub fn wait(&mut self, patience: Duration) -> Option<ExitStatus> {
        self.group.wait(patience)
    }

    fn await_end(&mut self, patience: Duration) -> anyhow::Result<ExitStatus> {
        let ended = self.group.wait(patience);
        ended.with_context(|| format!("the {} did not end when asked to", self.what))
    }

    /// Asks the process to end; one that does not is killed when this is dropped.
    pub fn dismiss(&mut self) {
        self.stdin = None;
        self.group.wait(DISMISSAL);
    }

    fn ended_early(&mut self, status: ExitStatus) -> anyhow::Result<()> {
        let said = self.last_words().unwrap_or_else(|| "it said nothing".into());
        bail!("the {} ended ({status}): {said}", self.what);
    }

    /// The last line that it wrote on standard error, if it has ended and wrote any.
    pub fn last_words(&mut self) -> Option<String> {
        if let Some(output) = &self.output {
            output.wait();
        }
        self.last_line()
    }

    /// The last line that it has written on standard error so far. It may take a moment to arrive.
    pub fn last_line(&self) -> Option<String> {
        let said = self.last_line.lock().unwrap_or_else(PoisonError::into_inner).clone()?;
        Some(said.strip_prefix("error: ").unwrap_or(&said).to_owned())
    }
}
