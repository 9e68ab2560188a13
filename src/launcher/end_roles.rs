//! The end of the roles, on the learner's host and on joined hosts.

use std::time::{Duration, Instant};

use shoal_common::role::Role;

use super::supervisor::Supervisor;

/// How often to look for ended processes if nothing wakes the launcher.
const REAP_INTERVAL: Duration = Duration::from_millis(100);

/// A launcher, for ending its roles.
pub(super) trait EndRoles {
    /// The processes of the roles.
    fn supervisor(&mut self) -> &mut Supervisor;

    /// Answers requests from other terminals.
    fn answer_requests(&mut self) -> anyhow::Result<()>;

    /// Sleeps at most `most`, until a process ends, a signal arrives or a request comes.
    fn sleep(&mut self, most: Duration);

    /// Waits until processes have ended that were asked to, and kills them after `patience`.
    fn await_end(&mut self, which: impl Fn(Role) -> bool + Copy, patience: Duration) {
        let deadline = Instant::now() + patience;
        while !self.supervisor().reap(which) {
            if Instant::now() >= deadline {
                self.supervisor().kill(which);
            }
            // An error here must not prevent the end.
            let _ = self.answer_requests();
            self.sleep(deadline.saturating_duration_since(Instant::now()).min(REAP_INTERVAL));
        }
    }
}
