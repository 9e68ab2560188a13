//! One role's process: started, listened to, ended.

use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::thread::JoinHandle;

use anyhow::Context;
use shoal_common::report::Identity;

use super::log::Log;

/// A running process of a role. It is told to end by closing its standard input; dropped, it is killed.
#[derive(Debug)]
pub(super) struct Process {
    child: Child,
    /// Held apart from the child: waiting for a child closes its own.
    stdin: Option<ChildStdin>,
    listener: Option<JoinHandle<()>>,
}

impl Process {
    /// Starts this program again as a role.
    pub(super) fn start(identity: Identity, run: &Path, log: &Log) -> anyhow::Result<Self> {
        let Identity {
            role,
            index,
            incarnation,
        } = identity;
        let mut child = Command::new("/proc/self/exe")
            .arg0("shoal")
            .arg(role.name())
            .arg(run)
            .args([index.to_string(), incarnation.to_string()])
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            // Ctrl-C is for the launcher, which ends the roles in order.
            .process_group(0)
            .spawn()
            .with_context(|| format!("cannot start {} {index}", role.name()))?;
        let stdin = child.stdin.take();
        let listener = child
            .stderr
            .take()
            .map(|stderr| listen(stderr, name(identity), log.clone()))
            .transpose()?;
        Ok(Self { child, stdin, listener })
    }

    pub(super) fn pid(&self) -> u32 {
        self.child.id()
    }

    /// How it ended, if it has; everything it wrote is in the log then.
    pub(super) fn exit_status(&mut self) -> Option<ExitStatus> {
        let status = self.child.try_wait().ok().flatten()?;
        if let Some(listener) = self.listener.take() {
            let _ = listener.join();
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

    /// Asks it to end.
    pub(super) fn ask_to_end(&mut self) {
        self.stdin = None;
    }

    /// Ends it without asking.
    pub(super) fn kill(&mut self) {
        let _ = self.child.kill();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if self.exit_status().is_none() {
            self.kill();
            let _ = self.child.wait();
        }
    }
}

/// What a process is called in the log and in messages.
pub(super) fn name(identity: Identity) -> String {
    format!("{}-{}", identity.role.name(), identity.index)
}

fn listen(from: impl Read + Send + 'static, who: String, log: Log) -> anyhow::Result<JoinHandle<()>> {
    std::thread::Builder::new()
        .name(who.clone())
        .spawn(move || {
            let mut lines = BufReader::new(from).split(b'\n');
            while let Some(Ok(line)) = lines.next() {
                log.line(&who, &String::from_utf8_lossy(&line));
            }
        })
        .context("cannot listen to a role")
}
