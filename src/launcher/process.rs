//! One role's process: started, listened to, ended.

use std::io::Write;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{ChildStdin, Command, ExitStatus};

use anyhow::Context;
use shoal_common::report::Identity;
use shoal_run::process::ChildGroup;
use shoal_run::process::ChildOutput;

use super::log::Log;

/// A running process of a role. It is told to end by closing its standard input; dropped, it is killed.
#[derive(Debug)]
pub(super) struct Process {
    group: ChildGroup,
    stdin: Option<ChildStdin>,
    output: Option<ChildOutput>,
}

impl Process {
    /// Starts this program again as a role.
    pub(super) fn start(identity: Identity, run: &Path, log: &Log) -> anyhow::Result<Self> {
        let Identity {
            role,
            index,
            incarnation,
        } = identity;
        let mut command = Command::new("/proc/self/exe");
        command.arg0("shoal").arg(role.name()).arg(run);
        command.args([index.to_string(), incarnation.to_string()]);
        let (group, stdin, stderr) =
            ChildGroup::start(&mut command).with_context(|| format!("cannot start {} {index}", role.name()))?;
        let (who, log) = (name(identity), log.clone());
        let read = stderr.map(|stderr| ChildOutput::read(&who.clone(), stderr, move |line| log.line(&who, line)));
        let output = read.transpose().context("cannot listen to a role")?;
        Ok(Self { group, stdin, output })
    }

    pub(super) fn pid(&self) -> u32 {
        self.group.pid().as_raw_pid() as u32
    }

    /// How it ended, if it has. What it wrote is in the log then.
    pub(super) fn exit_status(&mut self) -> Option<ExitStatus> {
        let status = self.group.exit_status()?;
        if let Some(output) = self.output.take() {
            output.wait();
        }
        Some(status)
    }

    /// Asks it to hand over what it has, and then to end.
    pub(super) fn ask_to_retire(&mut self) {
        if let Some(stdin) = &mut self.stdin {
            // Who does not hear it has ended.
            let _ = stdin.write_all(b"retire\n");
        }
    }

    /// Readable once it has ended; `None` where that was seen.
    pub(super) fn end(&self) -> Option<BorrowedFd<'_>> {
        self.group.is_alive().then(|| self.group.as_fd())
    }

    /// Asks it to end.
    pub(super) fn ask_to_end(&mut self) {
        self.stdin = None;
    }

    /// Ends it without asking.
    pub(super) fn kill(&mut self) {
        self.group.kill();
    }
}

/// What a process is called in the log and in messages.
pub(super) fn name(identity: Identity) -> String {
    format!("{}-{}", identity.role.name(), identity.index)
}
