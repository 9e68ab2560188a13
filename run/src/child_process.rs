//! Child processes: each is started in a process group of its own and ended together with everything it started; its
//! output is read.

mod group;
mod output;
mod process;
mod tied;

use std::os::fd::BorrowedFd;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use shoal_common::role::RoleInstance;

pub use self::group::ChildGroup;
pub use self::output::{ChildOutput, Line, OutputSource, escape_control_characters};
pub use self::process::ChildProcess;
pub use self::tied::{exec_tied, tie_to_parent, tied};

/// The command that starts this program as a role of the run in this directory.
pub fn role_command(instance: RoleInstance, run: &Path) -> Command {
    let RoleInstance {
        role,
        index,
        incarnation,
    } = instance;
    let mut command = Command::new("/proc/self/exe");
    command.arg0("shoal").arg(role.name()).arg(run);
    command.args([index.to_string(), incarnation.to_string()]);
    command
}

/// Waits at most `timeout` until one of these is readable, or a child whose [`ChildGroup`] is among them has ended.
/// Returns whether that happened. A signal to this process ends the wait early.
pub fn wait_for_any(wakers: &[BorrowedFd<'_>], timeout: Duration) -> bool {
    let mut ready: Vec<_> = wakers
        .iter()
        .map(|waker| PollFd::from_borrowed_fd(*waker, PollFlags::IN))
        .collect();
    // Only an absurdly long wait cannot be represented; it then has no limit.
    let timeout = Timespec::try_from(timeout).ok();
    match poll(&mut ready, timeout.as_ref()) {
        Ok(ready) => ready > 0,
        Err(Errno::INTR) => false,
        Err(_) => {
            // The kernel is short of memory: do not spin.
            std::thread::sleep(Duration::from_millis(10));
            false
        }
    }
}
