//! The system calls before which a process may be killed.

use nix::libc;
use nix::sys::ptrace;
use nix::unistd::Pid;

/// A kind of system call that has an effect on other processes or waits for them.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(crate) enum Call {
    /// Opens a file, possibly in shared memory.
    Open,
    /// Opens a file, and creates it if it does not exist.
    Create,
    /// Sets the size of a file.
    Ftruncate,
    /// Sets the permissions of a file.
    Fchmod,
    /// Maps a file as shared memory.
    Mmap,
    Write,
    Rename,
    Unlink,
    Mkdir,
    Fsync,
    /// Acquires or releases a lock of `fcntl` or `flock`.
    Lock,
    /// Binds a socket to a name in the file system.
    Bind,
    /// Sends a notification of an event.
    Send,
}

impl Call {
    pub(crate) const ALL: [Self; 13] = [
        Self::Open,
        Self::Create,
        Self::Ftruncate,
        Self::Fchmod,
        Self::Mmap,
        Self::Write,
        Self::Rename,
        Self::Unlink,
        Self::Mkdir,
        Self::Fsync,
        Self::Lock,
        Self::Bind,
        Self::Send,
    ];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Create => "create",
            Self::Ftruncate => "ftruncate",
            Self::Fchmod => "fchmod",
            Self::Mmap => "mmap",
            Self::Write => "write",
            Self::Rename => "rename",
            Self::Unlink => "unlink",
            Self::Mkdir => "mkdir",
            Self::Fsync => "fsync",
            Self::Lock => "lock",
            Self::Bind => "bind",
            Self::Send => "send",
        }
    }

    /// Whether a call with this number and these arguments is of this kind.
    fn is(self, number: i64, arguments: &[u64; 6]) -> bool {
        let flags = |index: usize| arguments[index] as i32;
        match self {
            Self::Open => opens(number, arguments).is_some(),
            Self::Create => opens(number, arguments).is_some_and(|flags| flags & libc::O_CREAT != 0),
            Self::Ftruncate => [libc::SYS_ftruncate, libc::SYS_fallocate].contains(&number),
            Self::Fchmod => [libc::SYS_fchmod, libc::SYS_fchmodat].contains(&number) || old::CHMOD.contains(&number),
            Self::Mmap => number == libc::SYS_mmap && flags(4) >= 0 && flags(3) & libc::MAP_SHARED != 0,
            Self::Write => [libc::SYS_write, libc::SYS_writev, libc::SYS_pwrite64].contains(&number),
            Self::Rename => {
                [libc::SYS_renameat, libc::SYS_renameat2, libc::SYS_linkat].contains(&number)
                    || old::RENAME.contains(&number)
            }
            Self::Unlink => number == libc::SYS_unlinkat || old::UNLINK.contains(&number),
            Self::Mkdir => number == libc::SYS_mkdirat || old::MKDIR.contains(&number),
            Self::Fsync => [libc::SYS_fsync, libc::SYS_fdatasync, libc::SYS_msync].contains(&number),
            Self::Lock => number == libc::SYS_flock || (number == libc::SYS_fcntl && LOCKS.contains(&flags(1))),
            Self::Bind => number == libc::SYS_bind,
            Self::Send => [libc::SYS_sendto, libc::SYS_sendmsg].contains(&number),
        }
    }
}

const LOCKS: [i32; 4] = [libc::F_SETLK, libc::F_SETLKW, libc::F_OFD_SETLK, libc::F_OFD_SETLKW];

/// The flags of a call that opens a file.
fn opens(number: i64, arguments: &[u64; 6]) -> Option<i32> {
    match number {
        libc::SYS_openat => Some(arguments[2] as i32),
        number if old::OPEN.contains(&number) => Some(arguments[1] as i32),
        _ => None,
    }
}

/// Calls that newer architectures lack.
#[cfg(target_arch = "x86_64")]
mod old {
    use nix::libc;

    pub(super) const OPEN: [i64; 1] = [libc::SYS_open];
    pub(super) const CHMOD: [i64; 1] = [libc::SYS_chmod];
    pub(super) const RENAME: [i64; 2] = [libc::SYS_rename, libc::SYS_link];
    pub(super) const UNLINK: [i64; 2] = [libc::SYS_unlink, libc::SYS_rmdir];
    pub(super) const MKDIR: [i64; 1] = [libc::SYS_mkdir];
}

#[cfg(not(target_arch = "x86_64"))]
mod old {
    pub(super) const OPEN: [i64; 0] = [];
    pub(super) const CHMOD: [i64; 0] = [];
    pub(super) const RENAME: [i64; 0] = [];
    pub(super) const UNLINK: [i64; 0] = [];
    pub(super) const MKDIR: [i64; 0] = [];
}

/// A system call that a stopped thread is about to make.
pub(crate) struct Entry {
    thread: Pid,
    number: i64,
    arguments: [u64; 6],
}

impl Entry {
    /// The call that this thread is about to enter; `None` if it stopped elsewhere.
    pub(crate) fn of(thread: Pid) -> Option<Self> {
        let stop = ptrace::syscall_info(thread).ok()?;
        if stop.op != libc::PTRACE_SYSCALL_INFO_ENTRY {
            return None;
        }
        let (number, arguments) = numbers(&ptrace::getregs(thread).ok()?);
        Some(Self {
            thread,
            number,
            arguments,
        })
    }

    /// All kinds of this call.
    pub(crate) fn kinds(&self) -> impl Iterator<Item = Call> + '_ {
        Call::ALL
            .into_iter()
            .filter(|call| call.is(self.number, &self.arguments))
    }

    /// Text for the user: the path, or the file of the descriptor.
    pub(crate) fn subject(&self) -> String {
        let [first, second, ..] = self.arguments;
        let at_path = [
            libc::SYS_openat,
            libc::SYS_fchmodat,
            libc::SYS_renameat,
            libc::SYS_renameat2,
            libc::SYS_unlinkat,
            libc::SYS_mkdirat,
        ];
        let plain = [&old::OPEN[..], &old::CHMOD, &old::RENAME, &old::UNLINK, &old::MKDIR];
        let subject = if at_path.contains(&self.number) {
            self.text(second)
        } else if plain.concat().contains(&self.number) {
            self.text(first)
        } else {
            let descriptor = if self.number == libc::SYS_mmap {
                self.arguments[4]
            } else {
                first
            };
            let link = std::fs::read_link(format!("/proc/{}/fd/{}", self.thread, descriptor as i32));
            link.ok().map(|path| path.display().to_string())
        };
        subject.unwrap_or_else(|| "?".into())
    }

    /// The zero-terminated text at an address of the process.
    fn text(&self, address: u64) -> Option<String> {
        let mut bytes = Vec::new();
        while bytes.len() < 512 && !bytes.contains(&0) {
            let at = address + bytes.len() as u64;
            let word = ptrace::read(self.thread, at as usize as ptrace::AddressType).ok()?;
            bytes.extend(word.to_ne_bytes());
        }
        let text = bytes.split(|byte| *byte == 0).next()?;
        Some(String::from_utf8_lossy(text).into_owned())
    }
}

#[cfg(target_arch = "x86_64")]
fn numbers(registers: &libc::user_regs_struct) -> (i64, [u64; 6]) {
    let r = registers;
    (r.orig_rax as i64, [r.rdi, r.rsi, r.rdx, r.r10, r.r8, r.r9])
}

#[cfg(target_arch = "aarch64")]
fn numbers(registers: &libc::user_regs_struct) -> (i64, [u64; 6]) {
    let r = registers.regs;
    (r[8] as i64, [r[0], r[1], r[2], r[3], r[4], r[5]])
}

/// Never called on other processors, because `tracer::is_allowed` returns false there.
#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
fn numbers(_registers: &libc::user_regs_struct) -> (i64, [u64; 6]) {
    unreachable!("this architecture is not traced")
}
