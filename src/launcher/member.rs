//! One place in the crew: who has it, how it gets on, and what its end means.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use shoal_common::channel::control::{RoleState, RoleStatus};
use shoal_common::report::{Activity, Heartbeat, Identity, Role};
use signal_hook::consts::{SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV};

use super::process::Process;

/// Failures in a row after which a role is given up.
pub(super) const LIMIT: u32 = 5;

/// The pause before the first restart after a failure; each further one is twice as long.
const FIRST_PAUSE: Duration = Duration::from_millis(100);

/// A process that has worked for so long has recovered from whatever made its predecessors fail.
const RECOVERED: Duration = Duration::from_secs(30);

/// A process that was not heard of for so long is stopped or stuck: it has a word to say twice a second.
const SILENT: Duration = Duration::from_secs(3);

/// Heartbeats closer together say nothing of the rate.
const SPAN: Duration = Duration::from_millis(400);

/// A role of the run, the process that has it now, and what became of those before.
#[derive(Debug)]
pub(super) struct Member {
    pub(super) identity: Identity,
    pub(super) process: Option<Process>,
    /// It was asked to hand over what it has, and is not to be replaced.
    pub(super) retires: bool,
    /// It was asked to end with the whole run.
    pub(super) ends: bool,
    pub(super) restarts: u32,
    pub(super) restart_at: Instant,
    begun: Instant,
    /// Failures since the last time it worked.
    failures: u32,
    heard: Option<(Instant, Heartbeat)>,
    /// When its rate was taken, and its steps then.
    span: (Instant, u64),
    rate: f64,
}

/// What the launcher does about the end of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Consequence {
    /// Starts it again after a pause.
    Restart(Duration),
    /// It cannot work.
    GiveUp,
}

impl Member {
    /// A place that nobody has yet.
    pub(super) fn new(role: Role, index: u32) -> Self {
        Self {
            identity: Identity {
                role,
                index,
                incarnation: 0,
            },
            process: None,
            retires: false,
            ends: false,
            restarts: 0,
            restart_at: Instant::now(),
            begun: Instant::now(),
            failures: 0,
            heard: None,
            span: (Instant::now(), 0),
            rate: 0.0,
        }
    }

    pub(super) fn is(&self, role: Role, index: u32) -> bool {
        (self.identity.role, self.identity.index) == (role, index)
    }

    /// Gives the place to a process.
    pub(super) fn begin(&mut self, process: Process) {
        self.process = Some(process);
        self.retires = false;
        self.begun = Instant::now();
        self.heard = None;
        self.rate = 0.0;
    }

    pub(super) fn is_ready(&self) -> bool {
        self.heard.is_some()
    }

    pub(super) fn activity(&self) -> Option<Activity> {
        self.heard?.1.activity()
    }

    /// Takes note of a sign of life; how long it took to be ready, if this is the first.
    pub(super) fn hear(&mut self, heartbeat: &Heartbeat) -> Option<Duration> {
        let now = Instant::now();
        let first = self.heard.replace((now, *heartbeat)).is_none();
        let (then, steps) = self.span;
        if first || now - then >= SPAN {
            let made = heartbeat.steps.saturating_sub(steps) as f64;
            self.rate = if first { 0.0 } else { made / (now - then).as_secs_f64() };
            self.span = (now, heartbeat.steps);
        }
        first.then(|| self.begun.elapsed())
    }

    /// Its process has ended, and nobody had asked it to.
    pub(super) fn ended(&mut self, status: ExitStatus) -> Consequence {
        self.process = None;
        // Killed while it worked is nobody's fault. A process that ends itself, or is ended by the system for what it
        // did, would do it again.
        let by_its_own = [SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV];
        let was_killed = status.signal().is_some_and(|signal| !by_its_own.contains(&signal));
        if self.is_ready() && was_killed {
            self.failures = 0;
            return Consequence::Restart(Duration::ZERO);
        }
        if self.is_ready() && self.begun.elapsed() >= RECOVERED {
            self.failures = 0;
        }
        self.failures += 1;
        if self.failures >= LIMIT {
            Consequence::GiveUp
        } else {
            Consequence::Restart(FIRST_PAUSE * 2_u32.pow(self.failures - 1))
        }
    }

    /// How it gets on, where the learner's newest policy is `newest`.
    pub(super) fn status(&self, newest: u64) -> RoleStatus {
        let Identity { role, index, .. } = self.identity;
        let policy_version = self
            .heard
            .filter(|_| role != Role::EnvServer)
            .map(|(_, heartbeat)| heartbeat.policy_version);
        let state = self.state();
        RoleStatus {
            role: role.name().into(),
            index,
            pid: self.process.as_ref().map(Process::pid),
            state,
            restarts: self.restarts,
            rate: if state == RoleState::Silent { 0.0 } else { self.rate },
            policy_version,
            policy_lag: policy_version.map(|version| newest.saturating_sub(version)),
        }
    }

    fn state(&self) -> RoleState {
        match (&self.process, self.heard) {
            (None, _) => RoleState::Restarting,
            (_, Some((then, _))) if then.elapsed() >= SILENT => RoleState::Silent,
            _ if self.retires => RoleState::Retiring,
            _ if self.ends => RoleState::Ending,
            (_, None) => RoleState::Starting,
            (_, Some((_, heartbeat))) => match heartbeat.activity() {
                Some(Activity::WaitingForPeer) => RoleState::WaitingForPeer,
                Some(Activity::WaitingForRatio) => RoleState::WaitingForRatio,
                Some(Activity::Done) => RoleState::Done,
                Some(Activity::Working) | None => RoleState::Working,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: i32 = 9;

    /// An ended process as `wait` describes it: by a signal, or with an exit code.
    fn by_signal(signal: i32) -> ExitStatus {
        ExitStatus::from_raw(signal)
    }

    fn with_code(code: i32) -> ExitStatus {
        ExitStatus::from_raw(code << 8)
    }

    fn ready(member: &mut Member) {
        member.hear(&Heartbeat::new(member.identity));
    }

    #[test]
    fn who_dies_again_and_again_before_it_is_ready_is_given_up_after_growing_pauses() {
        let mut member = Member::new(Role::Actor, 0);
        let ends: Vec<_> = (0..LIMIT).map(|_| member.ended(by_signal(KILLED))).collect();
        let pauses = [100, 200, 400, 800].map(|ms| Consequence::Restart(Duration::from_millis(ms)));
        assert_eq!(ends, [&pauses[..], &[Consequence::GiveUp]].concat());
    }

    #[test]
    fn being_killed_at_work_is_no_failure_and_forgives_earlier_ones() {
        let mut member = Member::new(Role::Learner, 0);
        for _ in 0..3 * LIMIT {
            assert!(matches!(member.ended(with_code(1)), Consequence::Restart(pause) if pause > Duration::ZERO));
            ready(&mut member);
            assert_eq!(member.ended(by_signal(KILLED)), Consequence::Restart(Duration::ZERO));
            member.heard = None;
        }
    }

    #[test]
    fn failing_after_being_ready_counts_too_whether_by_exit_or_by_a_fault() {
        for status in [with_code(1), by_signal(SIGBUS), by_signal(SIGSEGV)] {
            let mut member = Member::new(Role::Learner, 0);
            ready(&mut member);
            let last = (0..LIMIT).map(|_| member.ended(status)).last();
            assert_eq!(last, Some(Consequence::GiveUp), "{status}");
        }
    }
}
