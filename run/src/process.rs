//! Child processes: started in a group of their own, read, and ended with all that they started.

mod child_group;
mod child_output;
mod peer;

use std::os::fd::BorrowedFd;
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;

pub use self::child_group::ChildGroup;
pub use self::child_output::{ChildOutput, harmless};
pub use self::peer::Peer;

/// Waits until something can be read from one of these, or a child whose [`ChildGroup`] is among them has ended, but no longer than
/// `most`; whether one of them woke it. A signal to this process ends the wait sooner.
pub fn wait_for_any(wakers: &[BorrowedFd<'_>], most: Duration) -> bool {
    let mut ready: Vec<_> = wakers
        .iter()
        .map(|waker| PollFd::from_borrowed_fd(*waker, PollFlags::IN))
        .collect();
    // No wait is so long that it could not be said.
    let most = Timespec::try_from(most).ok();
    match poll(&mut ready, most.as_ref()) {
        Ok(ready) => ready > 0,
        Err(Errno::INTR) => false,
        Err(_) => {
            // The kernel has no memory for it at this moment: nobody shall spin.
            std::thread::sleep(Duration::from_millis(10));
            false
        }
    }
}
