//! A child process that takes commands on its standard input and prints replies on its standard output.

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, Command, ExitStatus, Stdio};
use std::sync::mpsc::{self, Receiver, RecvTimeoutError};
use std::time::Instant;

use rustix::process::{Pid, Signal, kill_process};
use shoal_common::channel::Domain;

use crate::children::{DIRECTORY, ROLE, RUN};
use crate::run::{TIMEOUT, eventually};

/// First character of a child's replies, which distinguishes them from the lines of its test harness.
pub(crate) const MARK: char = '@';

/// A child process. Dropping it kills the process.
pub(crate) struct Process {
    child: Child,
    stdin: Option<ChildStdin>,
    lines: Receiver<String>,
    role: String,
    run: String,
}

impl Process {
    pub(crate) fn launch(role: &str, run: &str, directory: &Path) -> Self {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["child", "--exact", "--ignored", "--nocapture"])
            .envs([(ROLE, role), (RUN, run)])
            .env(DIRECTORY, directory)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let (sender, lines) = mpsc::channel();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        std::thread::spawn(move || {
            let replies = stdout
                .lines()
                .map_while(Result::ok)
                .filter_map(|line| Some(line.strip_prefix(MARK)?.to_owned()));
            replies.for_each(|line| drop(sender.send(line)));
        });
        Self {
            stdin: child.stdin.take(),
            child,
            lines,
            role: role.into(),
            run: run.into(),
        }
    }

    /// Sends a command.
    pub(crate) fn tell(&mut self, command: &str) {
        writeln!(self.stdin.as_mut().unwrap(), "{command}").unwrap();
    }

    /// Waits for a line that begins with `words`. Returns the numbers after them.
    pub(crate) fn expect_line(&self, words: &str) -> Vec<u64> {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            let line = match self
                .lines
                .recv_timeout(deadline.saturating_duration_since(Instant::now()))
            {
                Ok(line) => line,
                Err(RecvTimeoutError::Timeout) => panic!("{} hangs: it does not print `{words}`", self.role),
                Err(RecvTimeoutError::Disconnected) => panic!("{} ended without printing `{words}`", self.role),
            };
            if let Some(numbers) = line.strip_prefix(words) {
                return numbers
                    .split_whitespace()
                    .map(|number| number.parse().unwrap())
                    .collect();
            }
        }
    }

    /// The number in the last remaining line that begins with `words`. Reads until the child closes its output.
    pub(crate) fn last_number(&self, words: &str) -> Option<u64> {
        let numbers = self
            .lines
            .iter()
            .filter_map(|line| line.strip_prefix(words)?.trim().parse().ok());
        numbers.last()
    }

    pub(crate) fn signal(&self, signal: Signal) {
        kill_process(Pid::from_child(&self.child), signal).unwrap();
    }

    /// Stops the process, and waits until none of its threads runs, because a signal takes effect later.
    pub(crate) fn stop(&self) {
        self.signal(Signal::STOP);
        let threads = format!("/proc/{}/task", self.child.id());
        eventually(&format!("{} is stopped", self.role), || {
            std::fs::read_dir(&threads).unwrap().all(|thread| {
                let stat = std::fs::read_to_string(thread.unwrap().path().join("stat")).unwrap();
                stat.rsplit_once(") ").is_some_and(|(_, state)| state.starts_with('T'))
            })
        });
    }

    /// Kills the process with `kill -9`, waits until it is gone, and cleans up after it as the launcher does.
    pub(crate) fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        // iceoryx2 does not always succeed at the first attempt.
        eventually(&format!("the shared memory of {} is cleaned up", self.role), || {
            Domain::clean_up(&self.run).unwrap() == 0
        });
    }

    /// Closes the child's standard input and waits until it has ended successfully.
    pub(crate) fn end(mut self) {
        self.stdin = None;
        let mut status: Option<ExitStatus> = None;
        eventually(&format!("{} ends", self.role), || {
            status = self.child.try_wait().unwrap();
            status.is_some()
        });
        assert!(status.unwrap().success(), "{}: {status:?}", self.role);
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
