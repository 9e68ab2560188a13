//! Follows a command and what it starts until the process that is to die, and kills that one just before a system call.
//!
//! Everybody else is let go as soon as it is known who it is, and runs at full speed. Tracing is a thread's: what is
//! traced dies with the thread, so nothing stays behind stopped.

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

/// Which process is to die.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Target {
    /// The command itself.
    Command,
    /// The first process of a role.
    Role(&'static str, u32),
    /// The first process of an environment server that is another program, from where it is that program.
    Program(u32),
}

/// Before which of its calls it is to die; the first is number 1.
pub(crate) type Aim = (Call, u32);

/// What became of a followed command.
#[derive(Debug, Default)]
pub(crate) struct Followed {
    /// Its exit code, or the signal that ended it, negative.
    pub(crate) code: i32,
    /// What the call was about before which the target was killed; `None` where it never made that call.
    pub(crate) hit: Option<String>,
    /// How many calls of each kind the target began.
    pub(crate) counts: BTreeMap<Call, u32>,
}

/// Whether this machine, and this kind of processor, allows to trace a child.
pub(crate) fn is_allowed() -> bool {
    let nothing = ["true".to_owned()];
    cfg!(any(target_arch = "x86_64", target_arch = "aarch64"))
        && follow(&nothing, |_| (), Target::Command, None).is_ok()
}

/// Starts the program with these arguments as `setting` says, and waits until it has ended; whoever calls this sees to it
/// that it ends. `Err` where the machine allows no tracing.
pub(crate) fn follow(
    program: &[String],
    setting: impl FnOnce(&mut Command),
    target: Target,
    aim: Option<Aim>,
) -> nix::Result<Followed> {
    // The shell waits for a word, and so can be seized before the program begins.
    let mut command = Command::new("sh");
    command
        .args(["-c", "read -r word && exec \"$@\" </dev/null", "sh"])
        .args(program);
    setting(&mut command);
    command.stdin(Stdio::piped());
    // The threads of a process have children of their own, and these are waited for here.
    let following = std::thread::Builder::new().name("tracer".into());
    let following = following.spawn(move || {
        #[expect(clippy::zombie_processes, reason = "all children of this thread are waited for")]
        let mut child = command.spawn().unwrap();
        let root = Pid::from_raw(child.id() as i32);
        let seized = ptrace::seize(root, everything());
        let mut tracer = Tracer::new(root, target, aim);
        match seized {
            Ok(()) => child.stdin.take().unwrap().write_all(b"go\n").unwrap(),
            Err(_) => drop(child.stdin.take()),
        }
        tracer.follow();
        seized.map(|()| tracer.followed)
    });
    following.unwrap().join().unwrap()
}

/// How a process is traced that may start the target.
fn everything() -> Options {
    let starts = Options::PTRACE_O_TRACEFORK | Options::PTRACE_O_TRACEVFORK | Options::PTRACE_O_TRACECLONE;
    starts | Options::PTRACE_O_TRACEEXEC | Options::PTRACE_O_EXITKILL
}

/// How the target is traced: its threads too, and nothing that it starts.
fn threads_and_calls() -> Options {
    Options::PTRACE_O_TRACECLONE | Options::PTRACE_O_TRACESYSGOOD | Options::PTRACE_O_EXITKILL
}

struct Tracer {
    root: Pid,
    target: Target,
    aim: Option<Aim>,
    /// The target's process, once it is there.
    found: Option<Pid>,
    /// Every thread that is traced, and whether it is the target's.
    threads: BTreeMap<Pid, bool>,
    followed: Followed,
}

impl Tracer {
    fn new(root: Pid, target: Target, aim: Option<Aim>) -> Self {
        Self {
            root,
            target,
            aim,
            found: None,
            threads: [(root, false)].into(),
            followed: Followed::default(),
        }
    }

    /// Until no child of this thread is left, traced or not.
    fn follow(&mut self) {
        loop {
            match waitpid(None, Some(WaitPidFlag::__WALL | WaitPidFlag::__WNOTHREAD)) {
                Ok(status) => self.look_at(status),
                Err(Errno::ECHILD) => return,
                // Interrupted, or ended by a signal that has no name.
                Err(_) => {}
            }
        }
    }

    fn look_at(&mut self, status: WaitStatus) {
        match status {
            WaitStatus::Exited(process, code) => self.ended(process, code),
            WaitStatus::Signaled(process, signal, _) => self.ended(process, -(signal as i32)),
            WaitStatus::PtraceSyscall(thread) => self.enters(thread),
            WaitStatus::PtraceEvent(process, _, libc::PTRACE_EVENT_EXEC) => self.begins(process),
            WaitStatus::PtraceEvent(thread, ..) => self.go_on(thread, None),
            WaitStatus::Stopped(thread, signal) => self.go_on(thread, Some(signal)),
            WaitStatus::Continued(_) | WaitStatus::StillAlive => {}
        }
    }

    fn ended(&mut self, process: Pid, code: i32) {
        self.threads.remove(&process);
        if process == self.root {
            self.followed.code = code;
        }
    }

    /// A process has become another program.
    fn begins(&mut self, process: Pid) {
        let words = std::fs::read(format!("/proc/{process}/cmdline")).unwrap_or_default();
        let words = String::from_utf8_lossy(&words).into_owned();
        let words: Vec<&str> = words.split('\0').collect();
        match self.is_target(process, &words) {
            _ if self.found.is_some() => self.go_on(process, None),
            Some(true) => {
                self.found = Some(process);
                self.threads.insert(process, true);
                let _ = ptrace::setoptions(process, threads_and_calls());
                self.go_on(process, None);
                for (other, _) in self.threads.iter().filter(|(_, is_target)| !**is_target) {
                    // They stop, and are let go.
                    let _ = ptrace::interrupt(*other);
                }
            }
            Some(false) => self.go_on(process, None),
            None => self.continue_thread(process, None),
        }
    }

    /// Whether this is the target; `None` where it neither is nor can start it or become it.
    fn is_target(&self, process: Pid, words: &[&str]) -> Option<bool> {
        let role = |name: &str, index: u32| words.get(1) == Some(&name) && words.get(3) == Some(&&*index.to_string());
        match self.target {
            Target::Command => (process == self.root).then_some(true),
            _ if process == self.root => Some(false),
            Target::Role(name, index) => role(name, index).then_some(true),
            Target::Program(index) if role("env-server", index) => {
                // What follows is the program itself.
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

    /// The target enters or leaves a system call.
    fn enters(&mut self, thread: Pid) {
        let Some(entry) = Entry::of(thread) else {
            return self.go_on(thread, None);
        };
        for call in entry.kinds() {
            let count = self.followed.counts.entry(call).or_default();
            *count += 1;
            if self.aim == Some((call, *count)) && self.followed.hit.is_none() {
                self.followed.hit = Some(entry.subject());
                // A thread that is killed here does not make the call.
                let _ = kill(self.found.unwrap_or(thread), Signal::SIGKILL);
                return;
            }
        }
        self.go_on(thread, None);
    }

    fn go_on(&mut self, thread: Pid, signal: Option<Signal>) {
        let known = self.threads.get(&thread).copied();
        let is_target = known.unwrap_or_else(|| self.found.is_some() && process_of(thread) == self.found);
        self.threads.insert(thread, is_target);
        // Whoever was killed meanwhile cannot go on, and says so next.
        let _ = match (is_target, self.found) {
            (true, _) => ptrace::syscall(thread, signal),
            (false, None) => ptrace::cont(thread, signal),
            (false, Some(_)) => return self.continue_thread(thread, signal),
        };
    }

    fn continue_thread(&mut self, thread: Pid, signal: Option<Signal>) {
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
