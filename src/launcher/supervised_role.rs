//! A role under the supervisor: its current process, its progress, and what follows when it ends.

use std::os::unix::process::ExitStatusExt;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use shoal_common::channel::control::{RoleState, RoleStatus};
use shoal_common::report::{Heartbeat, PROVEN_STEPS};
use shoal_common::role::{Activity, Role, RoleInstance};
use shoal_run::records::rate::per_second;
use signal_hook::consts::{SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV};

use super::process::Process;

/// A process that has lived this long, or an environment server that has taken [`PROVEN_STEPS`], is able to work. A
/// process that repeatedly fails earlier is not.
const PROVEN_AFTER: Duration = Duration::from_secs(30);

/// Failed starts after which a role is given up, if they span `run.give_up_seconds` and twice its longest start.
const MAX_FAILURES: u32 = 5;

/// The pause before the restart after the first failure. It doubles with each further failure, up to the longest.
const FIRST_PAUSE: Duration = Duration::from_millis(100);
const LONGEST_PAUSE: Duration = Duration::from_secs(4);

/// The time that a start may take, even if earlier ones were faster.
const START_TIME: Duration = Duration::from_secs(1);

/// A process without a heartbeat for this long is stopped or stuck. Heartbeats are sent twice a second.
pub(super) const SILENT_AFTER: Duration = Duration::from_secs(3);

/// The least time between two heartbeats from which a rate is computed.
const RATE_SPAN: Duration = Duration::from_millis(400);

/// A role of the run, its current process, and the history of the earlier ones.
#[derive(Debug)]
pub(super) struct SupervisedRole {
    pub(super) instance: RoleInstance,
    pub(super) process: Option<Process>,
    /// The exit status of a process whose end has been observed but not handled.
    pub(super) ended: Option<ExitStatus>,
    /// The process was asked to hand over its transitions and end; it is not replaced.
    pub(super) is_retiring: bool,
    /// The process was asked to end with the run.
    pub(super) is_asked_to_end: bool,
    pub(super) restarts: u32,
    pub(super) restart_at: Instant,
    started_at: Instant,
    /// Failed starts since the last process that was able to work; `None` if there were none.
    failures: Option<Failures>,
    /// The version of the policy in the process's first heartbeat. A learner begins with that of its checkpoint, an
    /// evaluator with that of its last evaluation.
    began_with: u64,
    /// `began_with` of the last process that was able to work and then failed by itself.
    failed_after: Option<u64>,
    /// The longest successful start: from the start until the process was ready.
    longest_good_start: Option<Duration>,
    /// The longest failed start: the life of a process that ended before it was ready.
    longest_failed_start: Duration,
    /// The last heartbeat of the current process, with its time of arrival.
    last_heartbeat: Option<(Instant, Heartbeat)>,
    /// When the process last made progress: started, took steps, got another policy, changed its activity, or continued
    /// after a silence.
    pub(super) progress_at: Instant,
    /// How often the process was replaced for lack of progress since it last took steps.
    pub(super) stalls: u32,
    /// The environment server that it uses, if any.
    server: Option<u32>,
    /// Whether the user was told that it is slow, since it was last heard of or started.
    reported_slow: bool,
    /// The process did not become ready in time and was killed for that.
    start_timed_out: bool,
    /// The time and the steps at which its rate was last computed.
    rate_computed_at: (Instant, u64),
    rate: f64,
}

/// Failed starts in a row.
#[derive(Clone, Copy, Debug)]
struct Failures {
    count: u32,
    /// When the first of them began.
    since: Instant,
}

/// The launcher's reaction to the end of a process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RestartDecision {
    /// Start the role again after this pause.
    Restart(Duration),
    /// Give the role up, after this many failures.
    GiveUp(u32),
}

impl SupervisedRole {
    /// A role without a process.
    pub(super) fn new(role: Role, index: u32) -> Self {
        let now = Instant::now();
        Self {
            instance: RoleInstance {
                role,
                index,
                incarnation: 0,
            },
            process: None,
            ended: None,
            is_retiring: false,
            is_asked_to_end: false,
            restarts: 0,
            restart_at: now,
            started_at: now,
            failures: None,
            began_with: 0,
            failed_after: None,
            longest_good_start: None,
            longest_failed_start: Duration::ZERO,
            last_heartbeat: None,
            progress_at: now,
            stalls: 0,
            server: (role == Role::Actor).then_some(index),
            rate_computed_at: (now, 0),
            reported_slow: false,
            start_timed_out: false,
            rate: 0.0,
        }
    }

    /// The same, for a role that uses environment server `index`.
    pub(super) fn with_server(self, index: u32) -> Self {
        Self {
            server: Some(index),
            ..self
        }
    }

    /// The environment server that it uses, if any.
    pub(super) fn server(&self) -> Option<u32> {
        self.server
    }

    pub(super) fn is(&self, role: Role, index: u32) -> bool {
        (self.instance.role, self.instance.index) == (role, index)
    }

    /// Assigns the role to a new process.
    pub(super) fn begin(&mut self, process: Process) {
        self.process = Some(process);
        self.ended = None;
        self.is_retiring = false;
        self.begin_at(Instant::now());
    }

    fn begin_at(&mut self, now: Instant) {
        self.started_at = now;
        self.progress_at = now;
        self.last_heartbeat = None;
        self.reported_slow = false;
        self.start_timed_out = false;
        self.rate = 0.0;
    }

    /// Invalid answers of its environment server that it has reported since it started.
    pub(super) fn faults(&self) -> u32 {
        self.last_heartbeat.map_or(0, |(_, heartbeat)| heartbeat.faults)
    }

    pub(super) fn is_ready(&self) -> bool {
        self.last_heartbeat.is_some()
    }

    pub(super) fn activity(&self) -> Option<Activity> {
        self.last_heartbeat?.1.activity()
    }

    /// Records a heartbeat. Returns how long the process took to be ready, if this is its first.
    pub(super) fn record(&mut self, heartbeat: &Heartbeat) -> Option<Duration> {
        self.record_at(heartbeat, Instant::now())
    }

    fn record_at(&mut self, heartbeat: &Heartbeat, now: Instant) -> Option<Duration> {
        self.reported_slow = false;
        let before = self.last_heartbeat.replace((now, *heartbeat));
        let first = before.is_none();
        let position = |heartbeat: &Heartbeat| (heartbeat.steps, heartbeat.policy_version, heartbeat.activity());
        // A process that was stopped could not make progress until now.
        let is_progress = |(then, before): (Instant, Heartbeat)| {
            now - then >= SILENT_AFTER || position(&before) != position(heartbeat)
        };
        if before.is_none_or(is_progress) {
            self.progress_at = now;
        }
        if heartbeat.steps > 0 {
            self.stalls = 0;
        }
        let (then, steps) = self.rate_computed_at;
        if first || now - then >= RATE_SPAN {
            let rate = per_second((Duration::ZERO, steps), (now - then, heartbeat.steps));
            self.rate = if first { 0.0 } else { rate.unwrap_or(0.0) };
            self.rate_computed_at = (now, heartbeat.steps);
        }
        let took = first.then(|| now - self.started_at)?;
        self.began_with = heartbeat.policy_version;
        self.longest_good_start = self.longest_good_start.max(Some(took));
        Some(took)
    }

    /// Handles the end of its process, which was not asked to end. The role is given up if its failures span
    /// `give_up_after`.
    pub(super) fn handle_end(&mut self, status: ExitStatus, give_up_after: Duration) -> RestartDecision {
        self.handle_end_at(status, give_up_after, Instant::now())
    }

    /// Restarts the role, unless it is given up. Not failures: the end of a process that was able to work, after which
    /// earlier failures are forgotten; and a kill while the process waited, after its first step, or within its usual
    /// start-up time. Failures: every other end, and a repeated end by itself of a process that was able to work but
    /// has saved nothing in between.
    fn handle_end_at(&mut self, status: ExitStatus, give_up_after: Duration, now: Instant) -> RestartDecision {
        (self.process, self.ended) = (None, None);
        let crash_signals = [SIGABRT, SIGBUS, SIGFPE, SIGILL, SIGSEGV];
        let was_killed = status.signal().is_some_and(|signal| !crash_signals.contains(&signal));
        let lived = now - self.started_at;
        let steps = self.last_heartbeat.map_or(0, |(_, heartbeat)| heartbeat.steps);
        let served = self.instance.role == Role::EnvServer && steps >= PROVEN_STEPS;
        if self.is_ready() && (lived >= PROVEN_AFTER || served) {
            if !was_killed && self.repeats_itself() {
                return self.count_failure(self.started_at, give_up_after, now);
            }
            self.failures = None;
            return RestartDecision::Restart(if was_killed { Duration::ZERO } else { FIRST_PAUSE });
        }
        let blameless = match self.activity() {
            Some(activity) => steps > 0 || activity != Activity::Working,
            None => {
                self.longest_failed_start = self.longest_failed_start.max(lived);
                !self.start_timed_out && lived <= START_TIME.max(self.longest_good_start.unwrap_or_default())
            }
        };
        if was_killed && blameless {
            return RestartDecision::Restart(if self.is_ready() { Duration::ZERO } else { FIRST_PAUSE });
        }
        self.count_failure(self.started_at, give_up_after, now)
    }

    /// Whether nothing was saved between the previous failure and this one, so that the next process would repeat the
    /// same work: both processes began with the same policy version. Only learner and evaluator continue from saved
    /// state.
    fn repeats_itself(&mut self) -> bool {
        matches!(self.instance.role, Role::Learner | Role::Evaluator)
            && self.failed_after.replace(self.began_with) == Some(self.began_with)
    }

    /// Handles a start that the system refused. The role is given up if its failures span `give_up_after`.
    pub(super) fn handle_refused_start(&mut self, give_up_after: Duration) -> RestartDecision {
        let now = Instant::now();
        self.count_failure(now, give_up_after, now)
    }

    /// Counts a failure of a start that began at `begun`.
    fn count_failure(&mut self, begun: Instant, give_up_after: Duration, now: Instant) -> RestartDecision {
        let failures = self.failures.get_or_insert(Failures { count: 0, since: begun });
        failures.count += 1;
        let Failures { count, since } = *failures;
        let longest = self
            .longest_failed_start
            .max(self.longest_good_start.unwrap_or_default());
        if count >= MAX_FAILURES && now - since >= give_up_after.max(2 * longest) {
            return RestartDecision::GiveUp(count);
        }
        let doubled = FIRST_PAUSE * 2_u32.pow((count - 1).min(10));
        RestartDecision::Restart(doubled.min(LONGEST_PAUSE))
    }

    /// Whether a recent heartbeat reports that it waits.
    pub(super) fn is_waiting(&self) -> bool {
        let waits = |activity| !matches!(activity, Activity::Working | Activity::Done);
        self.is_responsive() && self.activity().is_some_and(waits)
    }

    /// Whether it has a process that is expected to keep working.
    pub(super) fn is_active(&self) -> bool {
        self.process.is_some() && self.ended.is_none() && !self.is_retiring && !self.is_asked_to_end
    }

    /// Restarts the clocks for progress and heartbeats.
    pub(super) fn reset_clocks(&mut self) {
        self.progress_at = Instant::now();
        if let Some((then, _)) = &mut self.last_heartbeat {
            *then = self.progress_at;
        }
    }

    /// The time since its last heartbeat, or since its start.
    pub(super) fn silent_for(&self) -> Duration {
        self.last_heartbeat.map_or(self.progress_at, |(then, _)| then).elapsed()
    }

    /// How long it has been starting; `None` once it is ready or was killed, and while it has no process.
    pub(super) fn starting_for(&self) -> Option<Duration> {
        let is_starting = self.is_active() && !self.is_ready() && !self.start_timed_out;
        is_starting.then(|| self.started_at.elapsed())
    }

    /// Kills its process, which has not become ready in time. Its end counts as a failure.
    pub(super) fn kill_slow_start(&mut self) {
        self.start_timed_out = true;
        if let Some(process) = &mut self.process {
            process.kill();
        }
    }

    /// Marks it as reported slow. Returns false if it was marked already.
    pub(super) fn mark_reported_slow(&mut self) -> bool {
        !std::mem::replace(&mut self.reported_slow, true)
    }

    /// Whether its process is stopped, as by SIGSTOP or a debugger.
    pub(super) fn is_stopped(&self) -> bool {
        self.states_in_kernel().iter().any(|state| matches!(state, 'T' | 't'))
    }

    /// Whether all threads of its process sleep: none computes or waits for a device.
    pub(super) fn is_asleep(&self) -> bool {
        let states = self.states_in_kernel();
        !states.is_empty() && states.iter().all(|state| *state == 'S')
    }

    /// The state of each thread of its process, as in `ps`.
    fn states_in_kernel(&self) -> Vec<char> {
        let Some(process) = &self.process else {
            return Vec::new();
        };
        let threads = std::fs::read_dir(format!("/proc/{}/task", process.pid()));
        let state = |thread: std::fs::DirEntry| {
            let stat = std::fs::read_to_string(thread.path().join("stat")).ok()?;
            // After the name, which is in parentheses and may contain any character.
            stat.rsplit_once(") ")?.1.chars().next()
        };
        threads.into_iter().flatten().flatten().filter_map(state).collect()
    }

    /// Whether a heartbeat arrived recently.
    pub(super) fn is_responsive(&self) -> bool {
        self.last_heartbeat
            .is_some_and(|(then, _)| then.elapsed() < SILENT_AFTER)
    }

    /// Its status. `newest` is the version of the learner's newest policy.
    pub(super) fn status(&self, newest: u64) -> RoleStatus {
        let RoleInstance { role, index, .. } = self.instance;
        let policy_version = self
            .last_heartbeat
            .filter(|_| role != Role::EnvServer)
            .map(|(_, heartbeat)| heartbeat.policy_version);
        let state = self.state();
        RoleStatus {
            role,
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
        match (&self.process, self.last_heartbeat) {
            (None, _) if self.is_asked_to_end => RoleState::Done,
            (None, _) => RoleState::Restarting,
            (_, Some((then, _))) if then.elapsed() >= SILENT_AFTER => RoleState::Silent,
            _ if self.is_retiring => RoleState::Retiring,
            _ if self.is_asked_to_end => RoleState::Ending,
            (_, None) => RoleState::Starting,
            (_, Some((_, heartbeat))) => heartbeat.activity().map_or(RoleState::Working, RoleState::from),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const KILLED: i32 = 9;

    /// The exit status after this signal.
    fn by_signal(signal: i32) -> ExitStatus {
        ExitStatus::from_raw(signal)
    }

    /// The exit status with this exit code.
    fn with_code(code: i32) -> ExitStatus {
        ExitStatus::from_raw(code << 8)
    }

    /// A role with a simulated clock.
    struct Simulation {
        role: SupervisedRole,
        now: Instant,
    }

    impl Simulation {
        fn new(role: Role) -> Self {
            Self {
                role: SupervisedRole::new(role, 0),
                now: Instant::now(),
            }
        }

        /// A process lives for `lived` and then ends. It is ready after `ready`, with this last heartbeat.
        fn live(
            &mut self,
            lived: Duration,
            ready: Option<Duration>,
            last: Heartbeat,
            end: ExitStatus,
        ) -> RestartDecision {
            self.role.begin_at(self.now);
            if let Some(ready) = ready {
                self.role.record_at(&last, self.now + ready);
            }
            self.now += lived;
            let decision = self.role.handle_end_at(end, GIVE_UP_AFTER, self.now);
            if let RestartDecision::Restart(pause) = decision {
                self.now += pause;
            }
            decision
        }

        fn heartbeat(&self, activity: Activity, steps: u64) -> Heartbeat {
            let mut heartbeat = Heartbeat::new(self.role.instance);
            heartbeat.set_activity(activity);
            heartbeat.steps = steps;
            heartbeat
        }
    }

    const READY: Duration = Duration::from_millis(20);

    const GIVE_UP_AFTER: Duration = Duration::from_secs(30);

    #[test]
    fn a_process_that_continues_after_a_silence_has_not_been_idle() {
        let mut simulation = Simulation::new(Role::Evaluator);
        let begun = simulation.now;
        simulation.role.begin_at(begun);
        let waiting = simulation.heartbeat(Activity::WaitingForPeer, 5);
        let mut record = |second| {
            simulation.role.record_at(&waiting, begun + Duration::from_secs(second));
            (simulation.role.progress_at - begun).as_secs()
        };
        assert_eq!([record(1), record(2), record(4)], [1, 1, 1], "it waits");
        assert_eq!([record(64), record(65)], [64, 64], "it was stopped for a minute");
    }

    #[test]
    fn a_role_that_always_fails_is_given_up_after_half_a_minute_of_growing_pauses() {
        let mut simulation = Simulation::new(Role::Actor);
        let (begun, mut pauses) = (simulation.now, Vec::new());
        let last = simulation.heartbeat(Activity::Working, 0);
        while let RestartDecision::Restart(pause) = simulation.live(READY, None, last, with_code(1)) {
            pauses.push(pause.as_millis());
        }
        assert_eq!(pauses[..7], [100, 200, 400, 800, 1600, 3200, 4000]);
        let tried = simulation.now - begun;
        assert!((30..40).contains(&tried.as_secs()), "{tried:?}");
    }

    #[test]
    fn a_role_with_long_starts_is_given_up_later() {
        let mut simulation = Simulation::new(Role::EnvServer);
        let begun = simulation.now;
        let last = simulation.heartbeat(Activity::Working, 0);
        let mut starts = 1;
        while simulation.live(Duration::from_secs(60), None, last, with_code(1)) != RestartDecision::GiveUp(starts) {
            starts += 1;
        }
        assert_eq!(starts, MAX_FAILURES);
        assert!(simulation.now - begun >= Duration::from_secs(300));
    }

    #[test]
    fn being_killed_while_starting_waiting_or_working_is_not_a_failure() {
        let mut simulation = Simulation::new(Role::Evaluator);
        for _ in 0..1000 {
            let (idle, at_work) = (
                simulation.heartbeat(Activity::WaitingForPeer, 0),
                simulation.heartbeat(Activity::Working, 9),
            );
            for (ready, last) in [(None, idle), (Some(READY), idle), (Some(READY), at_work)] {
                let decision = simulation.live(10 * READY, ready, last, by_signal(KILLED));
                let pause = if ready.is_some() { Duration::ZERO } else { FIRST_PAUSE };
                assert_eq!(decision, RestartDecision::Restart(pause));
            }
        }
    }

    #[test]
    fn being_killed_after_the_usual_time_of_a_start_is_a_failure() {
        let mut simulation = Simulation::new(Role::EnvServer);
        let idle = simulation.heartbeat(Activity::WaitingForPeer, 0);
        simulation.live(READY, Some(READY), idle, by_signal(KILLED));
        let killed = |simulation: &mut Simulation, lived| simulation.live(lived, None, idle, by_signal(KILLED));
        assert_eq!(
            killed(&mut simulation, START_TIME),
            RestartDecision::Restart(FIRST_PAUSE)
        );
        let counted = (0..100).find_map(|_| match killed(&mut simulation, 2 * START_TIME) {
            RestartDecision::GiveUp(starts) => Some(starts),
            RestartDecision::Restart(_) => None,
        });
        assert!(counted.is_some());
    }

    #[test]
    fn a_role_that_never_starts_in_time_is_given_up() {
        let mut simulation = Simulation::new(Role::EnvServer);
        let given_up = (0..100).any(|_| {
            simulation.role.begin_at(simulation.now);
            simulation.role.kill_slow_start();
            simulation.now += READY;
            let decision = simulation
                .role
                .handle_end_at(by_signal(KILLED), GIVE_UP_AFTER, simulation.now);
            if let RestartDecision::Restart(pause) = decision {
                simulation.now += pause;
            }
            matches!(decision, RestartDecision::GiveUp(_))
        });
        assert!(given_up);
    }

    #[test]
    fn a_role_that_always_dies_in_its_first_step_is_given_up() {
        for end in [by_signal(KILLED), by_signal(SIGSEGV), with_code(1)] {
            let mut simulation = Simulation::new(Role::EnvServer);
            let in_first_step = simulation.heartbeat(Activity::Working, 0);
            let given_up = (0..100).any(|_| {
                let decision = simulation.live(10 * READY, Some(READY), in_first_step, end);
                matches!(decision, RestartDecision::GiveUp(_))
            });
            assert!(given_up, "{end}");
        }
    }

    #[test]
    fn a_role_that_always_fails_after_a_few_steps_is_given_up() {
        let mut simulation = Simulation::new(Role::EnvServer);
        let at_work = simulation.heartbeat(Activity::Working, 3);
        let mut ends = (0..100).map(|_| simulation.live(10 * READY, Some(READY), at_work, with_code(1)));
        assert!(ends.any(|end| matches!(end, RestartDecision::GiveUp(_))));
    }

    #[test]
    fn a_learner_that_always_fails_while_saving_is_given_up() {
        let mut simulation = Simulation::new(Role::Learner);
        let at_work = simulation.heartbeat(Activity::Working, 3000);
        let mut ends = (0..100).map(|_| simulation.live(Duration::from_secs(5), Some(READY), at_work, with_code(1)));
        assert!(ends.any(|end| matches!(end, RestartDecision::GiveUp(_))));
    }

    #[test]
    fn a_learner_that_fails_after_long_work_is_given_up_unless_it_has_saved_something_or_was_killed() {
        let live = |simulation: &mut Simulation, version, end| {
            let mut at_work = simulation.heartbeat(Activity::Working, 3000);
            at_work.policy_version = version;
            simulation.live(2 * PROVEN_AFTER, Some(READY), at_work, end)
        };
        for role in [Role::Learner, Role::Evaluator] {
            let mut simulation = Simulation::new(role);
            let mut ends = (0..10).map(|_| live(&mut simulation, 7, with_code(1)));
            assert!(ends.any(|end| matches!(end, RestartDecision::GiveUp(_))), "{role:?}");

            let mut simulation = Simulation::new(role);
            for version in 0..100 {
                assert_eq!(
                    live(&mut simulation, version, with_code(1)),
                    RestartDecision::Restart(FIRST_PAUSE)
                );
                assert_eq!(
                    live(&mut simulation, version, by_signal(KILLED)),
                    RestartDecision::Restart(Duration::ZERO)
                );
            }
        }
    }

    #[test]
    fn an_environment_server_that_fails_after_many_steps_is_always_restarted() {
        let mut simulation = Simulation::new(Role::EnvServer);
        let at_work = simulation.heartbeat(Activity::Working, 3000);
        for _ in 0..1000 {
            let decision = simulation.live(Duration::from_secs(1), Some(READY), at_work, with_code(1));
            assert_eq!(decision, RestartDecision::Restart(FIRST_PAUSE));
        }
    }
}
