//! A child of the supervisor: which process has its role, how it gets on, and what its end means.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use shoal_common::channel::control::{RoleState, RoleStatus};
use shoal_common::report::{Activity, Heartbeat, Identity, Role};
use shoal_run::rate::per_second;
use signal_hook::consts::{SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV};

use super::process::Process;

/// A process that has worked for so long, or an environment server that has taken so many steps, is able to work. One that
/// fails sooner, again and again, is not.
const ABLE: Duration = Duration::from_secs(30);
const ABLE_STEPS: u64 = 1000;

/// Starts without progress after which a role is given up, if they span [`SPAN_OF_FAILURES`] and twice its longest start.
const LIMIT: u32 = 5;
const SPAN_OF_FAILURES: Duration = Duration::from_secs(30);

/// The pause before the first restart after a failure; each further one is twice as long, up to the longest.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(4);

/// How long a start may take at least, however fast earlier ones were.
const START: Duration = Duration::from_secs(1);

/// A process that was not heard of for so long is stopped or stuck: it has a word to say twice a second.
pub(super) const SILENT: Duration = Duration::from_secs(3);

/// Heartbeats closer together say nothing of the rate.
const SPAN: Duration = Duration::from_millis(400);

/// A role of the run, the process that has it now, and what became of those before.
#[derive(Debug)]
pub(super) struct Child {
    pub(super) identity: Identity,
    pub(super) process: Option<Process>,
    /// How the process ended, where that has been seen and not been acted upon.
    pub(super) ended: Option<ExitStatus>,
    /// It was asked to hand over what it has, and is not to be replaced.
    pub(super) retires: bool,
    /// It was asked to end with the whole run.
    pub(super) ends: bool,
    pub(super) restarts: u32,
    pub(super) restart_at: Instant,
    begun: Instant,
    /// Starts without progress since the last one with progress, and when the first of them was.
    failures: u32,
    failing_since: Option<Instant>,
    /// The longest time that a start took until the process was ready, and the same with those that never were.
    usual_start: Option<Duration>,
    longest_start: Duration,
    heard: Option<(Instant, Heartbeat)>,
    /// When it was last seen to get on: to start, to take steps, to have another policy, or to do something else.
    pub(super) moved: Instant,
    /// How often it was replaced because it made no progress, since it last did.
    pub(super) stalls: u32,
    /// The environment server that it asks, if it asks one.
    server: Option<u32>,
    /// Whether the user was told that it is slow, since it was last heard of or started.
    reported_slow: bool,
    /// When its rate was taken, and its steps then.
    span: (Instant, u64),
    rate: f64,
}

/// What the launcher does about the end of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Consequence {
    /// Starts it again after a pause.
    Restart(Duration),
    /// It cannot work: after so many starts without progress.
    GiveUp(u32),
}

impl Child {
    /// A place that nobody has yet.
    pub(super) fn new(role: Role, index: u32) -> Self {
        let now = Instant::now();
        Self {
            identity: Identity {
                role,
                index,
                incarnation: 0,
            },
            process: None,
            ended: None,
            retires: false,
            ends: false,
            restarts: 0,
            restart_at: now,
            begun: now,
            failures: 0,
            failing_since: None,
            usual_start: None,
            longest_start: Duration::ZERO,
            heard: None,
            moved: now,
            stalls: 0,
            server: (role == Role::Actor).then_some(index),
            span: (now, 0),
            reported_slow: false,
            rate: 0.0,
        }
    }

    /// The same, of a role that asks environment server `index`.
    pub(super) fn with_server(self, index: u32) -> Self {
        Self {
            server: Some(index),
            ..self
        }
    }

    /// The environment server that it asks, if it asks one.
    pub(super) fn server(&self) -> Option<u32> {
        self.server
    }

    pub(super) fn is(&self, role: Role, index: u32) -> bool {
        (self.identity.role, self.identity.index) == (role, index)
    }

    /// Gives the place to a process.
    pub(super) fn begin(&mut self, process: Process) {
        self.process = Some(process);
        self.retires = false;
        self.begin_at(Instant::now());
    }

    fn begin_at(&mut self, now: Instant) {
        self.begun = now;
        self.moved = now;
        self.heard = None;
        self.reported_slow = false;
        self.rate = 0.0;
    }

    /// Invalid answers of its environment server that it has reported since it started.
    pub(super) fn faults(&self) -> u32 {
        self.heard.map_or(0, |(_, heartbeat)| heartbeat.faults)
    }

    pub(super) fn is_ready(&self) -> bool {
        self.heard.is_some()
    }

    pub(super) fn activity(&self) -> Option<Activity> {
        self.heard?.1.activity()
    }

    /// Takes note of a sign of life; how long it took to be ready, if this is the first.
    pub(super) fn hear(&mut self, heartbeat: &Heartbeat) -> Option<Duration> {
        self.hear_at(heartbeat, Instant::now())
    }

    fn hear_at(&mut self, heartbeat: &Heartbeat, now: Instant) -> Option<Duration> {
        self.reported_slow = false;
        let before = self.heard.replace((now, *heartbeat)).map(|(_, before)| before);
        let first = before.is_none();
        let position = |heartbeat: &Heartbeat| (heartbeat.steps, heartbeat.policy_version, heartbeat.activity());
        if before.is_none_or(|before| position(&before) != position(heartbeat)) {
            self.moved = now;
        }
        if heartbeat.steps > 0 {
            self.stalls = 0;
        }
        let (then, steps) = self.span;
        if first || now - then >= SPAN {
            let rate = per_second((Duration::ZERO, steps), (now - then, heartbeat.steps));
            self.rate = if first { 0.0 } else { rate.unwrap_or(0.0) };
            self.span = (now, heartbeat.steps);
        }
        let took = first.then(|| now - self.begun)?;
        self.usual_start = self.usual_start.max(Some(took));
        Some(took)
    }

    /// Its process has ended, and nobody had asked it to.
    pub(super) fn has_ended(&mut self, status: ExitStatus) -> Consequence {
        self.has_ended_at(status, Instant::now())
    }

    /// A process that was able to work will be again. One that was killed while it waited or after its first step, or in its
    /// usual start-up time, is not to blame. One that ended otherwise would do it again.
    fn has_ended_at(&mut self, status: ExitStatus, now: Instant) -> Consequence {
        (self.process, self.ended) = (None, None);
        let by_its_own = [SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV];
        let was_killed = status.signal().is_some_and(|signal| !by_its_own.contains(&signal));
        let lived = now - self.begun;
        let steps = self.heard.map_or(0, |(_, heartbeat)| heartbeat.steps);
        let served = self.identity.role == Role::EnvServer && steps >= ABLE_STEPS;
        if self.is_ready() && (lived >= ABLE || served) {
            (self.failures, self.failing_since) = (0, None);
            return Consequence::Restart(if was_killed { Duration::ZERO } else { FIRST_PAUSE });
        }
        let blameless = match self.activity() {
            Some(activity) => steps > 0 || activity != Activity::Working,
            None => {
                self.longest_start = self.longest_start.max(lived);
                lived <= START.max(self.usual_start.unwrap_or_default())
            }
        };
        if was_killed && blameless {
            return Consequence::Restart(if self.is_ready() { Duration::ZERO } else { FIRST_PAUSE });
        }
        self.failures += 1;
        let since = *self.failing_since.get_or_insert(self.begun);
        let longest = self.longest_start.max(self.usual_start.unwrap_or_default());
        if self.failures >= LIMIT && now - since >= SPAN_OF_FAILURES.max(2 * longest) {
            return Consequence::GiveUp(self.failures);
        }
        let doubled = FIRST_PAUSE * 2_u32.pow((self.failures - 1).min(10));
        Consequence::Restart(doubled.min(LONGEST_PAUSE))
    }

    /// Whether it was heard of a moment ago and said then that it waits.
    pub(super) fn waits(&self) -> bool {
        let says_so = |activity| !matches!(activity, Activity::Working | Activity::Done);
        self.is_heard() && self.activity().is_some_and(says_so)
    }

    /// Whether it has a process that is to go on working.
    pub(super) fn is_present(&self) -> bool {
        self.process.is_some() && self.ended.is_none() && !self.retires && !self.ends
    }

    /// Begins anew to count how long it makes no progress.
    pub(super) fn excuse(&mut self) {
        self.moved = Instant::now();
        if let Some((then, _)) = &mut self.heard {
            *then = self.moved;
        }
    }

    /// How long nothing was heard of it.
    pub(super) fn silent_for(&self) -> Duration {
        self.heard.map_or(self.moved, |(then, _)| then).elapsed()
    }

    /// How long it has been starting; `None` once it is ready, and while it has no process.
    pub(super) fn starting_for(&self) -> Option<Duration> {
        (self.is_present() && !self.is_ready()).then(|| self.begun.elapsed())
    }

    /// Ends its process, which has not become ready in time.
    pub(super) fn end_slow_start(&mut self) {
        self.begun = Instant::now();
        if let Some(process) = &mut self.process {
            process.kill();
        }
    }

    /// Takes note that the user is told that it is slow; whether that is news.
    pub(super) fn report_slow(&mut self) -> bool {
        !std::mem::replace(&mut self.reported_slow, true)
    }

    /// Whether its process is stopped.
    pub(super) fn is_stopped(&self) -> bool {
        self.states_in_kernel().iter().any(|state| matches!(state, 'T' | 't'))
    }

    /// Whether no thread of its process computes or waits for a device.
    pub(super) fn sleeps(&self) -> bool {
        let states = self.states_in_kernel();
        !states.is_empty() && states.iter().all(|state| *state == 'S')
    }

    /// The state of each thread of its process, as `ps` has it.
    fn states_in_kernel(&self) -> Vec<char> {
        let Some(process) = &self.process else {
            return Vec::new();
        };
        let threads = std::fs::read_dir(format!("/proc/{}/task", process.pid()));
        let state = |thread: std::fs::DirEntry| {
            let stat = std::fs::read_to_string(thread.path().join("stat")).ok()?;
            // Behind the name, which is in brackets and may hold anything.
            stat.rsplit_once(") ")?.1.chars().next()
        };
        threads.into_iter().flatten().flatten().filter_map(state).collect()
    }

    /// Whether it was heard of a moment ago.
    pub(super) fn is_heard(&self) -> bool {
        self.heard.is_some_and(|(then, _)| then.elapsed() < SILENT)
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
                Some(Activity::WaitingForPeer | Activity::WaitingForServer) => RoleState::WaitingForPeer,
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

    /// A place whose time is told, and not waited for.
    struct Place {
        child: Child,
        now: Instant,
    }

    impl Place {
        fn new(role: Role) -> Self {
            Self {
                child: Child::new(role, 0),
                now: Instant::now(),
            }
        }

        /// A process lives for so long, is ready after so long, says this last, and then ends.
        fn lives(&mut self, lived: Duration, ready: Option<Duration>, last: Heartbeat, end: ExitStatus) -> Consequence {
            self.child.begin_at(self.now);
            if let Some(ready) = ready {
                self.child.hear_at(&last, self.now + ready);
            }
            self.now += lived;
            let consequence = self.child.has_ended_at(end, self.now);
            if let Consequence::Restart(pause) = consequence {
                self.now += pause;
            }
            consequence
        }

        fn says(&self, activity: Activity, steps: u64) -> Heartbeat {
            let mut heartbeat = Heartbeat::new(self.child.identity);
            heartbeat.set_activity(activity);
            heartbeat.steps = steps;
            heartbeat
        }
    }

    const READY: Duration = Duration::from_millis(20);

    #[test]
    fn who_fails_again_and_again_is_given_up_after_half_a_minute_of_growing_pauses() {
        let mut place = Place::new(Role::Actor);
        let (begun, mut pauses) = (place.now, Vec::new());
        let last = place.says(Activity::Working, 0);
        while let Consequence::Restart(pause) = place.lives(READY, None, last, with_code(1)) {
            pauses.push(pause.as_millis());
        }
        assert_eq!(pauses[..7], [100, 200, 400, 800, 1600, 3200, 4000]);
        let tried = place.now - begun;
        assert!((30..40).contains(&tried.as_secs()), "{tried:?}");
    }

    #[test]
    fn who_takes_long_to_start_is_given_up_later() {
        let mut place = Place::new(Role::EnvServer);
        let begun = place.now;
        let last = place.says(Activity::Working, 0);
        let mut starts = 1;
        while place.lives(Duration::from_secs(60), None, last, with_code(1)) != Consequence::GiveUp(starts) {
            starts += 1;
        }
        assert_eq!(starts, LIMIT);
        assert!(place.now - begun >= Duration::from_secs(300));
    }

    #[test]
    fn being_killed_while_it_waits_or_starts_or_works_is_nobodys_fault() {
        let mut place = Place::new(Role::Evaluator);
        for _ in 0..1000 {
            let (idle, at_work) = (
                place.says(Activity::WaitingForPeer, 0),
                place.says(Activity::Working, 9),
            );
            for (ready, last) in [(None, idle), (Some(READY), idle), (Some(READY), at_work)] {
                let consequence = place.lives(10 * READY, ready, last, by_signal(KILLED));
                let pause = if ready.is_some() { Duration::ZERO } else { FIRST_PAUSE };
                assert_eq!(consequence, Consequence::Restart(pause));
            }
        }
    }

    #[test]
    fn a_start_that_is_killed_after_it_should_have_been_ready_counts() {
        let mut place = Place::new(Role::EnvServer);
        let idle = place.says(Activity::WaitingForPeer, 0);
        place.lives(READY, Some(READY), idle, by_signal(KILLED));
        let killed = |place: &mut Place, lived| place.lives(lived, None, idle, by_signal(KILLED));
        assert_eq!(killed(&mut place, START), Consequence::Restart(FIRST_PAUSE));
        let counted = (0..100).find_map(|_| match killed(&mut place, 2 * START) {
            Consequence::GiveUp(starts) => Some(starts),
            Consequence::Restart(_) => None,
        });
        assert!(counted.is_some());
    }

    #[test]
    fn who_dies_over_its_first_step_is_given_up_whatever_the_signal() {
        for end in [by_signal(KILLED), by_signal(SIGSEGV), with_code(1)] {
            let mut place = Place::new(Role::EnvServer);
            let over_a_step = place.says(Activity::Working, 0);
            let given_up = (0..100).any(|_| {
                let consequence = place.lives(10 * READY, Some(READY), over_a_step, end);
                matches!(consequence, Consequence::GiveUp(_))
            });
            assert!(given_up, "{end}");
        }
    }

    #[test]
    fn who_fails_after_a_few_steps_every_time_is_given_up() {
        let mut place = Place::new(Role::EnvServer);
        let at_work = place.says(Activity::Working, 3);
        let mut ends = (0..100).map(|_| place.lives(10 * READY, Some(READY), at_work, with_code(1)));
        assert!(ends.any(|end| matches!(end, Consequence::GiveUp(_))));
    }

    #[test]
    fn a_learner_that_fails_whenever_it_saves_is_given_up() {
        let mut place = Place::new(Role::Learner);
        let at_work = place.says(Activity::Working, 3000);
        let mut ends = (0..100).map(|_| place.lives(Duration::from_secs(5), Some(READY), at_work, with_code(1)));
        assert!(ends.any(|end| matches!(end, Consequence::GiveUp(_))));
    }

    #[test]
    fn who_fails_now_and_then_is_forgiven() {
        let mut place = Place::new(Role::EnvServer);
        let at_work = place.says(Activity::Working, 3000);
        for _ in 0..1000 {
            let consequence = place.lives(Duration::from_secs(1), Some(READY), at_work, with_code(1));
            assert_eq!(consequence, Consequence::Restart(FIRST_PAUSE));
        }
    }
}
