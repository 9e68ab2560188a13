//! The end of the roles, on the learner's host and on joined hosts.

use std::time::{Duration, Instant};

use shoal_common::channel::Domain;
use shoal_common::role::Role;

use super::supervisor::Supervisor;

/// How often to look for ended processes if nothing wakes the launcher.
const REAP_INTERVAL: Duration = Duration::from_millis(100);

/// How long to wait for a receiver that is being restarted when the roles are requested to end.
const RECEIVER_RESTART_TIMEOUT: Duration = Duration::from_secs(5);

/// A request to end the roles, and the result to return afterwards.
#[derive(Clone, Copy, Debug)]
pub(super) struct EndRequest<End> {
    at: Instant,
    pub(super) end: End,
}

impl<End> EndRequest<End> {
    /// A request that has just come.
    pub(super) fn new(end: End) -> Self {
        let at = Instant::now();
        Self { at, end }
    }

    /// Whether the end may begin. If `receiver`, the role to which the actors send, has just died, it is restarted
    /// first.
    pub(super) fn may_begin(&self, supervisor: &Supervisor, receiver: Role) -> bool {
        supervisor.is_ready(receiver) || self.at.elapsed() >= RECEIVER_RESTART_TIMEOUT
    }
}

/// A launcher, for ending its roles.
pub(super) trait EndRoles {
    /// The processes of the roles, and where they find each other.
    fn parts(&mut self) -> (&mut Supervisor, &Domain);

    /// Answers requests from other terminals.
    fn answer_requests(&mut self) -> anyhow::Result<()>;

    /// Sleeps at most `most`, until a process ends, a signal arrives or a request comes.
    fn sleep(&mut self, most: Duration);

    /// Waits until the processes that were asked to end have ended. Kills them after `timeout`.
    fn await_end(&mut self, which: impl Fn(Role) -> bool + Copy, timeout: Duration, receiver: Option<Role>) {
        if !self.have_ended_within(timeout, which, receiver) {
            self.parts().0.kill(which, "did not end when asked to");
        }
    }

    /// Waits at most `timeout` until the processes that were asked to end have ended. If the `receiver` of what they
    /// send dies meanwhile, it is started again, once. Returns whether they have ended.
    fn have_ended_within(
        &mut self,
        timeout: Duration,
        which: impl Fn(Role) -> bool,
        mut receiver: Option<Role>,
    ) -> bool {
        let deadline = Instant::now() + timeout;
        loop {
            let (supervisor, domain) = self.parts();
            if supervisor.reap(&which) {
                return true;
            }
            if Instant::now() >= deadline {
                return false;
            }
            // Once restarted, or if that fails, the receiver is left alone: the run must end in any case.
            receiver = receiver.filter(|role| matches!(supervisor.restart_if_dead(*role, domain), Ok(false)));
            // An error here must not prevent the end.
            let _ = self.answer_requests();
            self.sleep(deadline.saturating_duration_since(Instant::now()).min(REAP_INTERVAL));
        }
    }
}
