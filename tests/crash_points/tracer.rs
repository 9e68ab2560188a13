//! Traces a command and its descendants until the target process appears, and kills that one just before a system call.
//!
//! Other processes are detached as soon as they are recognised and then run at full speed. Traced processes die with
//! the tracing thread, so none is left stopped.

use std::collections::BTreeMap;
use std::io::Write;
use std::process::{Command, Stdio};

use nix::errno::Errno;
use nix::libc;
use nix::sys::ptrace::{self, Options};
use nix::sys::signal::{Signal, kill};
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;

use crate::calls::{Call, Entry};

/// The process to kill.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Target {
    /// The command itself.
    Command,
    /// The first process of a role.
    Role(&'static str, u32),
    /// The first process of an environment server that is another program, from the moment it executes that program.
    Program(u32),
}

/// The call before which to kill the target: its kind, and its number among the calls of this kind, from 1.
pub(crate) type CrashPoint = (Call, u32);

/// The result of a traced command.
#[derive(Debug, Default)]
pub(crate) struct Followed {
    /// Its exit code, or the negated signal that ended it.
    pub(crate) code: i32,
    /// The path or file of the call before which the target was killed; `None` if it never made that call.
    pub(crate) hit: Option<String>,
    /// Calls of each kind that the target began.
    pub(crate) counts: BTreeMap<Call, u32>,
}

/// Whether this machine allows tracing a child, and its processor is supported.
pub(crate) fn is_allowed() -> bool {
    let nothing = ["true".to_owned()];
    cfg!(any(target_arch = "x86_64", target_arch = "aarch64"))
        && follow(&nothing, |_| (), Target::Command, None).is_ok()
}

/// Starts `program`, a command line, after `prepare` has configured the command, and waits until it has ended. The
/// caller must ensure that it ends. Returns an error if the machine does not allow tracing.
pub(crate) fn follow(
    program: &[String],
    prepare: impl FnOnce(&mut Command),
    target: Target,
    crash_point: Option<CrashPoint>,
) -> nix::Result<Followed> {
    // The shell waits for a line, so that it can be seized before the program starts.
    let mut command = Command::new("sh");
    command
        .args(["-c", "read -r word && exec \"$@\" </dev/null", "sh"])
        .args(program);
    prepare(&mut command);
    command.stdin(Stdio::piped());
    // In a separate thread, which waits for all of its children and for no others.
    let following = std::thread::Builder::new().name("tracer".into());
    let following = following.spawn(move || {
        #[expect(
            clippy::zombie_processes,
            reason = "the tracer waits for all children of this thread"
        )]
        let mut child = command.spawn().unwrap();
        let root = Pid::from_raw(child.id() as i32);
        let seized = ptrace::seize(root, descendants());
        let mut tracer = Tracer::new(root, target, crash_point);
        match seized {
            Ok(()) => child.stdin.take().unwrap().write_all(b"go\n").unwrap(),
            Err(_) => drop(child.stdin.take()),
        }
        tracer.follow();
        seized.map(|()| tracer.followed)
    });
    following.unwrap().join().unwrap()
}

/// Options for a process that may start the target.
fn descendants() -> Options {
    let starts = Options::PTRACE_O_TRACEFORK | Options::PTRACE_O_TRACEVFORK | Options::PTRACE_O_TRACECLONE;
    starts | Options::PTRACE_O_TRACEEXEC | Options::PTRACE_O_EXITKILL
}

/// Options for the target: includes its threads, but not its children.
fn threads_and_calls() -> Options {
    Options::PTRACE_O_TRACECLONE | Options::PTRACE_O_TRACESYSGOOD | Options::PTRACE_O_EXITKILL
}

struct Tracer {
    root: Pid,
    target: Target,
    crash_point: Option<CrashPoint>,
    /// The target's process, once it exists.
    found: Option<Pid>,
    /// All traced threads, and whether each belongs to the target.
    threads: BTreeMap<Pid, bool>,
    followed: Followed,
}

impl Tracer {
    fn new(root: Pid, target: Target, crash_point: Option<CrashPoint>) -> Self {
        Self {
            root,
            target,
            crash_point,
            found: None,
            threads: [(root, false)].into(),
            followed: Followed::default(),
        }
    }

    /// Handles events until no child of this thread is left, traced or not.
    fn follow(&mut self) {
        loop {
            match waitpid(None, Some(WaitPidFlag::__WALL | WaitPidFlag::__WNOTHREAD)) {
                Ok(status) => self.handle(status),
                Err(Errno::ECHILD) => return,
                // The wait was interrupted, or the child was ended by a signal unknown to nix.
                Err(_) => {}
            }
        }
    }

    fn handle(&mut self, status: WaitStatus) {
        match status {
            WaitStatus::Exited(process, code) => self.ended(process, code),
            WaitStatus::Signaled(process, signal, _) => self.ended(process, -(signal as i32)),
            WaitStatus::PtraceSyscall(thread) => self.enters(thread),
            WaitStatus::PtraceEvent(process, _, libc::PTRACE_EVENT_EXEC) => self.executes(process),
            WaitStatus::PtraceEvent(thread, ..) => self.resume(thread, None),
            WaitStatus::Stopped(thread, signal) => self.resume(thread, Some(signal)),
            WaitStatus::Continued(_) | WaitStatus::StillAlive => {}
        }
    }

    fn ended(&mut self, process: Pid, code: i32) {
        self.threads.remove(&process);
        if process == self.root {
            self.followed.code = code;
        }
    }

    /// Handles the event that a process executes another program.
    fn executes(&mut self, process: Pid) {
        let words = std::fs::read(format!("/proc/{process}/cmdline")).unwrap_or_default();
        let words = String::from_utf8_lossy(&words).into_owned();
        let words: Vec<&str> = words.split('\0').collect();
        match self.is_target(process, &words) {
            _ if self.found.is_some() => self.resume(process, None),
            Some(true) => {
                self.found = Some(process);
                self.threads.insert(process, true);
                let _ = ptrace::setoptions(process, threads_and_calls());
                self.resume(process, None);
                for (other, _) in self.threads.iter().filter(|(_, is_target)| !**is_target) {
                    // They stop, and are then detached.
                    let _ = ptrace::interrupt(*other);
                }
            }
            Some(false) => self.resume(process, None),
            None => self.detach(process, None),
        }
    }

    /// Whether this is the target; `None` if it neither is the target nor can become or start it.
    fn is_target(&self, process: Pid, words: &[&str]) -> Option<bool> {
        let role = |name: &str, index: u32| words.get(1) == Some(&name) && words.get(3) == Some(&&*index.to_string());
        match self.target {
            Target::Command => (process == self.root).then_some(true),
            _ if process == self.root => Some(false),
            Target::Role(name, index) => role(name, index).then_some(true),
            Target::Program(index) if role("env-server", index) => {
                // This process will execute the program.
                Some(false)
            }
            Target::Program(index) => {
                let serves = |pair: &[&str]| pair == ["--index", &index.to_string()];
                let is_of_the_run =
                    |pair: &[&str]| pair[0] == "--iceoryx2" && pair[1].ends_with("config/iceoryx2.toml");
                (words.windows(2).any(serves) && words.windows(2).any(is_of_the_run)).then_some(true)
            }
        }
    }

    /// Handles the event that the target enters or leaves a system call.
    fn enters(&mut self, thread: Pid) {
        let Some(entry) = Entry::of(thread) else {
            return self.resume(thread, None);
        };
        for call in entry.kinds() {
            let count = self.followed.counts.entry(call).or_default();
            *count += 1;
            if self.crash_point == Some((call, *count)) && self.followed.hit.is_none() {
                self.followed.hit = Some(entry.subject());
                // A thread that is killed at this point does not make the call.
                let _ = kill(self.found.unwrap_or(thread), Signal::SIGKILL);
                return;
            }
        }
        self.resume(thread, None);
    }

    fn resume(&mut self, thread: Pid, signal: Option<Signal>) {
        let known = self.threads.get(&thread).copied();
        let is_target = known.unwrap_or_else(|| self.found.is_some() && process_of(thread) == self.found);
        self.threads.insert(thread, is_target);
        // This fails for a process that was killed in the meantime; its end is reported next.
        let _ = match (is_target, self.found) {
            (true, _) => ptrace::syscall(thread, signal),
            (false, None) => ptrace::cont(thread, signal),
            (false, Some(_)) => return self.detach(thread, signal),
        };
    }

    fn detach(&mut self, thread: Pid, signal: Option<Signal>) {
        self.threads.remove(&thread);
        let _ = ptrace::detach(thread, signal);
    }
}

/// The process that a thread belongs to.
fn process_of(thread: Pid) -> Option<Pid> {
    let status = std::fs::read_to_string(format!("/proc/{thread}/status")).ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("Tgid:"))?;
    line.trim().parse().ok().map(Pid::from_raw)
}
