//! The process of a role: its start, its output and its end.

use std::io::Write;
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::process::{ChildStdin, ExitStatus};

use anyhow::Context;
use shoal_common::role::RoleInstance;
use shoal_run::child_process::{ChildGroup, ChildOutput, OutputSource, role_command};

use super::log::Log;

/// The process of a role. Closing its standard input asks it to end. It is killed on drop.
#[derive(Debug)]
pub(super) struct Process {
    group: ChildGroup,
    stdin: Option<ChildStdin>,
    output: Option<ChildOutput>,
}

impl Process {
    /// Starts this program as a role. `source` is who writes to its standard error.
    pub(super) fn start(instance: RoleInstance, run: &Path, log: &Log, source: OutputSource) -> anyhow::Result<Self> {
        let started = ChildGroup::start(&mut role_command(instance, run));
        let (group, stdin, stderr) =
            started.with_context(|| format!("cannot start {} {}", instance.role.name(), instance.index))?;
        let (who, log) = (name(instance), log.clone());
        let read = stderr
            .map(|stderr| ChildOutput::read(&who.clone(), stderr, source, move |line| log.line(&who, line, source)));
        let output = read.transpose().context("cannot read the output of a role")?;
        Ok(Self { group, stdin, output })
    }

    pub(super) fn pid(&self) -> u32 {
        self.group.pid().as_raw_pid() as u32
    }

    /// Its exit status, once it has ended. Its output is in the log by then.
    pub(super) fn exit_status(&mut self) -> Option<ExitStatus> {
        let status = self.group.exit_status()?;
        if let Some(output) = self.output.take() {
            output.wait();
        }
        Some(status)
    }

    /// Asks it to hand over its transitions and then to end.
    pub(super) fn ask_to_retire(&mut self) {
        if let Some(stdin) = &mut self.stdin {
            // This fails only if the process has ended.
            let _ = stdin.write_all(b"retire\n");
        }
    }

    /// A descriptor that becomes readable when the process ends; `None` once its end has been observed.
    pub(super) fn exit_descriptor(&self) -> Option<BorrowedFd<'_>> {
        self.group.is_alive().then(|| self.group.as_fd())
    }

    /// Asks it to end.
    pub(super) fn ask_to_end(&mut self) {
        self.stdin = None;
    }

    /// Kills it.
    pub(super) fn kill(&mut self) {
        self.group.kill();
    }
}

/// The name of a process in the log and in messages.
pub(super) fn name(instance: RoleInstance) -> String {
    format!("{}-{}", instance.role.name(), instance.index)
}

/// How a process has ended.
pub(super) fn describe_exit(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(signal), _) => format!("killed by signal {signal}"),
        (_, Some(code)) => format!("ended with exit code {code}"),
        _ => "ended".into(),
    }
}
