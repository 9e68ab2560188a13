//! The launcher: starts the roles of a run, watches them, writes the records, and ends the roles.

mod child;
mod cleaner;
mod end_roles;
mod incarnations;
mod joined_hosts;
#[cfg_attr(
    not(feature = "remote"),
    expect(dead_code, reason = "only `join` uses it, which is not built")
)]
pub(crate) mod joined_launcher;
mod local_actors;
mod log;
mod process;
mod progress;
mod requests;
mod shares;
mod stall;
mod supervisor;

use std::time::{Duration, Instant};

use anyhow::Context;
use shoal_common::channel::control::{ControlPort, ControlRequest, ControlResponse, RunStatus};
use shoal_common::channel::reports::{Report, Reports};
use shoal_common::channel::{Domain, DomainError};
use shoal_common::config::{Config, Mode};
use shoal_common::message::one_line;
use shoal_common::report::{EpisodeReport, EvaluationReport, Heartbeat, LearnerReport};
use shoal_common::role::Role;
use shoal_common::run_dir::{LockedRun, RunDir};
use shoal_common::stop::GRACE;
use shoal_run::client::in_final_evaluation;
use shoal_run::external_environment::server_iceoryx2_config;
use shoal_run::records::outcome::{OutcomeReason, RunOutcome, RunState};
use shoal_run::records::recorder::Recorder;
use shoal_run::signals::Signals;
use shoal_run::{preflight, signals, status};
use signal_hook::consts::SIGTERM;

pub(crate) use self::cleaner::run_in_child as run_clean_up;
use self::end_roles::{EndRequest, EndRoles};
use self::log::Log;
pub(crate) use self::log::{ALL_ENDED, FAILED, note};
use self::progress::ProgressLine;
use self::stall::StallDetector;
use self::supervisor::{SupervisedHost, Supervisor};

/// How often the launcher reads reports and checks its children if nothing wakes it. Ticks start short and become
/// longer while reports arrive slowly: a full buffer loses its oldest reports.
const TICK: Duration = Duration::from_millis(500);
const SHORTEST_TICK: Duration = Duration::from_millis(20);

/// If less than this share of a report buffer is filled in a tick, the next tick is longer.
const LOW_FILL: f64 = 0.1;

/// How long the last evaluation's report may take after the learner is done. The learner has waited for the evaluation.
const LAST_EVALUATION_TIMEOUT: Duration = Duration::from_secs(1);

/// Why a request that needs roles is not carried out while they end and the run may continue with others.
const ROLES_END: &str = "the processes of the run are ending";

/// How long actors of a run that is stopped wait until everything is committed, even while there is no learner.
const ACTORS_HAND_OVER_TIMEOUT: Duration = Duration::from_secs(2);
/// How long actors may take to end after that. In a run that was not stopped, this is all the time they have.
const ACTORS_END_TIMEOUT: Duration = Duration::from_secs(3);
/// How long the other roles may take to end. The learner saves its state in this time.
const OTHERS_END_TIMEOUT: Duration = Duration::from_secs(15);

/// How long the gate may take to let the other hosts hand over their last chunks.
const GATE_END_TIMEOUT: Duration = Duration::from_secs(8);

/// How long the roles of a killed launcher may take to end. One that is stuck ends after [`GRACE`].
const PREDECESSORS_TIMEOUT: Duration = GRACE.saturating_add(Duration::from_secs(5));

/// How often the run may get new shared memory within an hour.
const MAX_RENEWALS: usize = 5;
const HOUR: Duration = Duration::from_secs(3600);

/// How a run ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum RunEnd {
    /// All steps are taken and learned from.
    Finished,
    /// It was stopped by `shoal stop`; the learner saved its state.
    Stopped,
    /// This signal ended it; the learner saved its state.
    Interrupted(i32),
}

impl RunEnd {
    /// Whether joined hosts end with the run. With `hosts_wait`, SIGTERM leaves them waiting.
    fn ends_hosts(self, hosts_wait: bool) -> bool {
        !(hosts_wait && self == Self::Interrupted(SIGTERM))
    }
}

/// Why the roles were ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum RolesEnd {
    /// The run has ended.
    Run(RunEnd),
    /// Dead processes occupy shared memory that cannot be freed, or another program has removed files of the run: it
    /// continues in new shared memory.
    Renewal,
}

/// The result of a training, or of a part of it.
#[derive(Clone, Debug)]
pub(crate) struct TrainingOutcome<Ending = RunEnd> {
    pub(crate) ending: Ending,
    pub(crate) wall: Duration,
    /// The run's status when this launcher started, and now.
    pub(crate) before: RunStatus,
    pub(crate) after: RunStatus,
}

/// How a launcher shows what it does, and whether other hosts may join its run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct RunOptions {
    /// No live line.
    pub(crate) quiet: bool,
    /// There is a gate, at the endpoint in `join.toml`.
    pub(crate) gate: bool,
    /// The other hosts do not end with a run that SIGTERM ends.
    pub(crate) hosts_wait: bool,
}

/// Runs all roles until the learner is done, a signal arrives, or `shoal stop` asks for the end.
pub(crate) fn run(
    config: Config,
    run: &LockedRun,
    signals: &Signals,
    options: RunOptions,
) -> anyhow::Result<TrainingOutcome> {
    let ended = run_and_renew(config, run, signals, options);
    ended.inspect_err(|error| record_failed_start(run, error))
}

/// Waits until the roles of an earlier launcher, which was killed, have ended. Until then they may read and write the
/// run's files.
///
/// # Errors
/// When some do not end. That is recorded as the run's outcome.
pub(crate) fn wait_for_predecessors(run_id: &str, run: &LockedRun) -> anyhow::Result<()> {
    if Domain::wait_for_earlier_processes(run_id, Duration::ZERO).is_ok() {
        return Ok(());
    }
    if let Some(outcome) = RunOutcome::read(run)?.filter(|outcome| outcome.state == RunState::Running) {
        // For `shoal status`, which nobody answers until there is a launcher.
        outcome.with_reason(OutcomeReason::Starting).write(run)?;
    }
    let waited = Domain::wait_for_earlier_processes(run_id, PREDECESSORS_TIMEOUT);
    waited
        .map_err(|error| name_original_run(error, run))
        .inspect_err(|error| record_failed_start(run, error))
}

/// Waits as [`wait_for_predecessors`] does, but records nothing. The roles of another run that this directory is a copy
/// of do not count: they use their own directory.
///
/// # Errors
/// When some do not end.
pub(crate) fn wait_for_roles_here(run_id: &str, run: &RunDir) -> anyhow::Result<()> {
    let is_another = |error: &DomainError| original_run(error, run).is_some();
    match Domain::wait_for_earlier_processes(run_id, Duration::ZERO) {
        Err(error) if is_another(&error) => return Ok(()),
        Ok(()) => return Ok(()),
        Err(_) => {}
    }
    match Domain::wait_for_earlier_processes(run_id, PREDECESSORS_TIMEOUT) {
        Err(error) if !is_another(&error) => Err(error.into()),
        _ => Ok(()),
    }
}

/// Records that the run has failed, unless a launcher has recorded how it ended.
fn record_failed_start(run: &LockedRun, error: &anyhow::Error) {
    if run.check().is_ok()
        && let Ok(Some(outcome)) = RunOutcome::read(run)
        && outcome.state == RunState::Running
    {
        // The roles were never started, so no launcher has written how the run ended.
        let state = RunState::Failed;
        let failed = RunOutcome { state, ..outcome }.with_reason(one_line(error));
        // An error here must not hide the original one.
        let _ = failed.write(run);
    }
}

/// Runs all roles, again in new shared memory whenever that is needed.
fn run_and_renew(
    mut config: Config,
    run: &LockedRun,
    signals: &Signals,
    options: RunOptions,
) -> anyhow::Result<TrainingOutcome> {
    let (mut renewals, mut before, mut wall) = (Vec::new(), None, Duration::ZERO);
    loop {
        let part = run_once(config, run, signals, options)?;
        wall += part.wall;
        let before = before.get_or_insert(part.before);
        if let RolesEnd::Run(ending) = part.ending {
            return Ok(TrainingOutcome {
                ending,
                wall,
                before: before.clone(),
                after: part.after,
            });
        }
        renewals.retain(|then: &Instant| then.elapsed() < HOUR);
        renewals.push(Instant::now());
        if renewals.len() > MAX_RENEWALS {
            anyhow::bail!(
                "the run got new shared memory {MAX_RENEWALS} times within an hour; the log has the reasons. If a program \
                 cleans up /dev/shm or /tmp, exclude this run's files, then `shoal resume {}` continues the run",
                run.path().display()
            );
        }
        // The run may have been scaled.
        config = run.config()?;
    }
}

fn run_once(
    config: Config,
    run: &LockedRun,
    signals: &Signals,
    options: RunOptions,
) -> anyhow::Result<TrainingOutcome<RolesEnd>> {
    run.check()?;
    let saved = status::saved_status(&config, run)?;
    let starts =
        RunOutcome::new(RunState::Running, saved.env_steps, saved.episodes).with_reason(OutcomeReason::Starting);
    starts.write(run)?;
    wait_for_predecessors(&config.run.id, run)?;
    // The wait may have been long: by now another run may be at its place.
    run.check()?;
    Domain::remove_abandoned()?;
    let domain = Domain::join(&config.run.id, config.actors.max_on_a_host())?;
    let outcome = preflight::reserve(&config, run, &domain)
        .and_then(|()| Launcher::new(config, run, &domain, signals, options))
        .and_then(Launcher::run);
    // Also after an error: no role is left by now.
    let left = domain.leave();
    let outcome = outcome?;
    left?;
    Ok(outcome)
}

/// If the surviving processes belong to a run that this directory is a copy of, names that run in the error.
fn name_original_run(error: DomainError, run: &RunDir) -> anyhow::Error {
    match original_run(&error, run) {
        Some(there) => {
            let here = run.path().display();
            anyhow::anyhow!("{here} is a copy of {there}, which is running: stop that run first")
        }
        None => error.into(),
    }
}

/// The directory of the surviving processes, if they belong to a run that this directory is a copy of.
fn original_run(error: &DomainError, run: &RunDir) -> Option<String> {
    let DomainError::StillAlive { pids, .. } = error else {
        return None;
    };
    // Only roles name their directory in a fixed place: their arguments are role, run directory and two numbers.
    let directory = |pid: &i32| {
        let arguments = std::fs::read(format!("/proc/{pid}/cmdline")).ok()?;
        let arguments = String::from_utf8_lossy(&arguments);
        let mut arguments = arguments.split('\0').skip(1);
        let is_role = Role::from_name(arguments.next()?).is_some();
        arguments.next().filter(|_| is_role).map(str::to_owned)
    };
    let here = run.path().display().to_string();
    pids.iter().find_map(directory).filter(|there| *there != here)
}

/// What the launcher is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    AtWork,
    /// It ends the roles, and the run with them. The other hosts end too.
    RunEnds,
    /// It ends the roles, but the other hosts wait: the run has failed, moves to new shared memory, or is to be
    /// resumed.
    RolesEnd,
}

struct Launcher<'a> {
    config: Config,
    run: &'a LockedRun,
    domain: &'a Domain,
    control: ControlPort,
    /// The run's status when this launcher started.
    initial: RunStatus,
    /// The first request to end the run.
    end_request: Option<EndRequest<RunEnd>>,
    phase: Phase,
    hosts_wait: bool,
    supervisor: Supervisor,
    log: Log,
    recorder: Recorder,
    progress: ProgressLine,
    signals: &'a Signals,
    stalls: StallDetector,
    started_at: Instant,
    tick: Duration,
    longest_tick: Duration,
    heartbeats: Reports<Heartbeat>,
    episode_reports: Reports<EpisodeReport>,
    evaluation_reports: Reports<EvaluationReport>,
    learner_reports: Reports<LearnerReport>,
}

impl<'a> Launcher<'a> {
    fn new(
        config: Config,
        run: &'a LockedRun,
        domain: &'a Domain,
        signals: &'a Signals,
        RunOptions {
            quiet,
            gate,
            hosts_wait,
        }: RunOptions,
    ) -> anyhow::Result<Self> {
        let log = Log::open(&run.log())?;
        write_iox_config(domain, run)?;
        std::fs::create_dir_all(run.checkpoints()).context("cannot create the directory for checkpoints")?;
        if config.evaluation.keep_policies {
            std::fs::create_dir_all(run.policies()).context("cannot create the directory for policies")?;
        }
        // An actor may report more episodes at once than its channel holds.
        let many_reports = config.chunk_rows() > EpisodeReport::BUFFER;
        let longest_tick = if many_reports { SHORTEST_TICK } else { TICK };
        let mut recorder = Recorder::open(run, &config.replay)?;
        recorder.settings(&config)?;
        let initial = status::saved_status(&config, run)?;
        RunOutcome::new(RunState::Running, initial.env_steps, initial.episodes).write(run)?;
        // Creates the services that are opened below.
        let supervisor = Supervisor::new(&config, run, domain, log.clone(), SupervisedHost::OfLearner { gate })?;
        Ok(Self {
            control: ControlPort::open(domain, config.actors.max)?,
            initial,
            end_request: None,
            phase: Phase::AtWork,
            hosts_wait,
            run,
            domain,
            heartbeats: Reports::open(domain)?,
            episode_reports: Reports::open(domain)?,
            evaluation_reports: Reports::open(domain)?,
            learner_reports: Reports::open(domain)?,
            supervisor,
            stalls: StallDetector::new(Duration::from_secs(config.run.stall_seconds)),
            log,
            recorder,
            progress: ProgressLine::new(&config, run, quiet),
            config,
            signals,
            started_at: Instant::now(),
            tick: SHORTEST_TICK,
            longest_tick,
        })
    }

    fn run(mut self) -> anyhow::Result<TrainingOutcome<RolesEnd>> {
        let mut ending = self.watch();
        if let Err(gone) = self.run.check() {
            // The roles cannot save anything. By now, another run may be at this path, so none may be started either.
            self.supervisor.kill(|_| true);
            ending = Err(gone.into());
        }
        // The roles are ended in every case, also after an error.
        self.progress.set_message("ending");
        let ended = self.end_all(ending.as_ref().ok().copied());
        if matches!(ending, Ok(RolesEnd::Renewal))
            && let Some(request) = self.end_request
        {
            ending = Ok(RolesEnd::Run(request.end));
        }
        self.progress.clear();
        self.control.answer_waiting(&match (&ended, &ending) {
            // A request to stop came too late.
            (Ok(()), Ok(RolesEnd::Run(RunEnd::Finished))) => ControlResponse::Refused(in_final_evaluation(self.run)),
            (Ok(()), _) => ControlResponse::Accepted,
            (Err(error), _) => ControlResponse::Refused(format!("{error:#}")),
        });
        // If the directory is gone, all other errors follow from that, and nothing may be written at its path. The open
        // log is still the run's own.
        self.run
            .check()
            .inspect_err(|gone| self.log.note("launcher", &format!("{FAILED}{gone}")))?;
        let renewed = matches!(ending, Ok(RolesEnd::Renewal));
        let failure = ending.as_ref().err().or(ended.as_ref().err().filter(|_| !renewed));
        if let Some(error) = failure {
            let why = one_line(error);
            self.log.note("launcher", &format!("{FAILED}{why}"));
            // An error here must not hide the original one.
            let _ = self
                .outcome(RunState::Failed)
                .map(|outcome| outcome.with_reason(why).write(self.run));
        }
        let ending = ending?;
        // With new shared memory, the learner continues from its newest checkpoint.
        ended.or_else(|error| {
            if ending == RolesEnd::Renewal {
                Ok(())
            } else {
                Err(error)
            }
        })?;
        self.recorder.flush()?;
        // What the learner saved: its last report may have arrived too late.
        let after = status::saved_status(&self.config, self.run)?;
        let stopped = RunOutcome::new(RunState::Stopped, after.env_steps, after.episodes);
        match ending {
            RolesEnd::Run(RunEnd::Stopped) => stopped.with_reason("by request".to_owned()).write(self.run)?,
            RolesEnd::Run(RunEnd::Interrupted(signal)) => {
                stopped.with_reason(format!("signal {signal}")).write(self.run)?
            }
            // The final evaluation of a finished run is still to come.
            RolesEnd::Run(RunEnd::Finished) | RolesEnd::Renewal => {}
        }
        Ok(TrainingOutcome {
            ending,
            wall: self.started_at.elapsed(),
            after,
            before: self.initial,
        })
    }

    fn outcome(&self, state: RunState) -> anyhow::Result<RunOutcome> {
        let saved = status::saved_status(&self.config, self.run)?;
        Ok(RunOutcome::new(state, saved.env_steps, saved.episodes))
    }

    fn watch(&mut self) -> anyhow::Result<RolesEnd> {
        self.run.check()?;
        self.supervisor.start_all(self.domain)?;
        loop {
            self.take_signal();
            self.run.check()?;
            self.read_reports()?;
            self.answer_requests()?;
            let condition = match (self.supervisor.maintain(self.domain), self.end_request) {
                // A run that is about to end needs no role that cannot work.
                (Err(_), Some(request)) => return Ok(RolesEnd::Run(request.end)),
                (condition, _) => condition?,
            };
            match condition {
                supervisor::RunCondition::AtWork => {}
                supervisor::RunCondition::LearnerDone => {
                    self.await_last_evaluation()?;
                    return Ok(RolesEnd::Run(RunEnd::Finished));
                }
                supervisor::RunCondition::SharedMemoryOccupied | supervisor::RunCondition::FilesRemoved
                    if self.end_request.is_some() => {}
                supervisor::RunCondition::SharedMemoryOccupied => {
                    return Ok(self.report_renewal("dead processes occupy shared memory permanently"));
                }
                supervisor::RunCondition::FilesRemoved => {
                    let directory = self.domain.directory()?;
                    let what = format!(
                        "another program has removed files of this run in {}",
                        directory.display()
                    );
                    return Ok(self.report_renewal(&what));
                }
            }
            for message in self.supervisor.check_progress(&mut self.stalls) {
                self.progress.print(&message);
            }
            if let Some(request) = self.end_request
                && request.may_begin(&self.supervisor, Role::Learner)
            {
                return Ok(RolesEnd::Run(request.end));
            }
            self.progress.draw(&self.supervisor);
            self.sleep(self.tick.min(self.supervisor.time_to_next_task()));
        }
    }

    /// Takes a signal that has come as a request to end the run.
    fn take_signal(&mut self) {
        if let Some(signal) = self.signals.received()
            && self.end_request.is_none()
        {
            self.log
                .note("launcher", &format!("{} ends the run", signals::describe(signal)));
            self.end_request = Some(EndRequest::new(RunEnd::Interrupted(signal)));
        }
    }

    /// Logs and prints why the run continues in new shared memory. Returns [`RolesEnd::Renewal`].
    fn report_renewal(&self, why: &str) -> RolesEnd {
        let why = format!("{why}: the run continues in new shared memory");
        self.log.note("launcher", &why);
        self.progress.print(&why);
        RolesEnd::Renewal
    }

    /// Waits for the report on the last period's policy.
    fn await_last_evaluation(&mut self) -> anyhow::Result<()> {
        let last = status::saved_status(&self.config, self.run)?.env_steps;
        let begun = Instant::now();
        while begun.elapsed() < LAST_EVALUATION_TIMEOUT && self.signals.received().is_none() {
            self.read_reports()?;
            self.answer_requests()?;
            let period = |steps| self.config.evaluation.period(steps);
            if self.recorder.evaluated().map(period) >= Some(period(last)) {
                break;
            }
            self.sleep(SHORTEST_TICK);
        }
        Ok(())
    }

    /// Ends all roles, the actors first, so that the learner still receives what they send. The other hosts are told if
    /// the run is over, also if a request to end it comes while the roles end. If it is renewed or to be resumed, or
    /// after an error (`None`), they are not told, and wait for it.
    fn end_all(&mut self, ending: Option<RolesEnd>) -> anyhow::Result<()> {
        let hosts_wait = self.hosts_wait;
        self.phase = match ending {
            Some(RolesEnd::Run(end)) if end.ends_hosts(hosts_wait) => Phase::RunEnds,
            _ => Phase::RolesEnd,
        };
        let was_asked = matches!(ending, Some(RolesEnd::Run(RunEnd::Stopped | RunEnd::Interrupted(_))));
        let receiver = was_asked.then_some(Role::Learner);
        // A lockstep run collects its unfinished round again, so its actors have nothing to hand over.
        if was_asked && self.config.run.mode == Mode::Free {
            self.supervisor.ask_to_retire(Role::Actor);
            self.have_ended_within(ACTORS_HAND_OVER_TIMEOUT, |role| role == Role::Actor, receiver);
        }
        self.supervisor.ask_to_end(|role| role == Role::Actor);
        self.await_end(|role| role == Role::Actor, ACTORS_END_TIMEOUT, receiver);
        self.take_signal();
        let is_over = |end_request: Option<EndRequest<RunEnd>>| match ending {
            Some(RolesEnd::Renewal) => end_request.is_some_and(|request| request.end.ends_hosts(hosts_wait)),
            Some(RolesEnd::Run(end)) => end.ends_hosts(hosts_wait),
            None => false,
        };
        let are_told = is_over(self.end_request);
        // They hand over what they have while the learner is still there.
        let mut told = if are_told { self.tell_hosts(receiver) } else { Ok(()) };
        self.supervisor.ask_to_end(|_| true);
        self.await_end(|_| true, OTHERS_END_TIMEOUT, None);
        self.take_signal();
        if !are_told && is_over(self.end_request) {
            told = self.tell_hosts(None);
        }
        self.read_reports()?;
        self.supervisor.check_saved()?;
        told
    }

    /// Tells the other hosts that the run is over. A gate that has just died, or dies meanwhile, is started again for
    /// that.
    fn tell_hosts(&mut self, receiver: Option<Role>) -> anyhow::Result<()> {
        let deadline = Instant::now() + GATE_END_TIMEOUT;
        self.supervisor.ensure_gate(self.domain)?;
        loop {
            self.supervisor.ask_to_retire(Role::Gate);
            let left = deadline.saturating_duration_since(Instant::now());
            self.await_end(|role| role == Role::Gate, left, receiver);
            let may_try_again = self.supervisor.has_failed(Role::Gate) && Instant::now() < deadline;
            if !(may_try_again && self.supervisor.ensure_gate(self.domain)?) {
                return Ok(());
            }
        }
    }

    fn read_reports(&mut self) -> anyhow::Result<()> {
        let wall = self.started_at.elapsed();
        while let Some(heartbeat) = self.heartbeats.receive()? {
            self.supervisor.record(&heartbeat);
        }
        for incident in self.supervisor.take_incidents() {
            self.recorder.incident(&incident, wall)?;
        }
        self.recorder.hosts(&self.supervisor.joined_hosts(), wall)?;
        self.supervisor.check_faults()?;
        let fills = [
            each(&self.episode_reports, |report| {
                Ok(self.recorder.episode(&report, wall)?)
            })?,
            each(&self.evaluation_reports, |report| {
                // A restarted evaluator reports some again.
                let is_new = self.recorder.evaluated() < Some(report.env_steps);
                self.progress.set_evaluation(&report, is_new);
                Ok(self.recorder.evaluation(&report, wall)?)
            })?,
            each(&self.learner_reports, |report| {
                self.progress.add_learner_report(&report, wall);
                Ok(self.recorder.learner(&report, wall)?)
            })?,
        ];
        self.tick = match fills.into_iter().fold(0.0, f64::max) {
            0.0..=LOW_FILL => self.tick * 3 / 2,
            fill => self.tick.mul_f64(LOW_FILL / fill),
        }
        .clamp(SHORTEST_TICK, self.longest_tick);
        Ok(())
    }
}

impl EndRoles for Launcher<'_> {
    fn parts(&mut self) -> (&mut Supervisor, &Domain) {
        (&mut self.supervisor, self.domain)
    }

    /// A request to stop is answered when the run has ended.
    fn answer_requests(&mut self) -> anyhow::Result<()> {
        let now = self.recorder.moment(self.started_at.elapsed());
        let Self {
            config,
            run,
            control,
            supervisor,
            progress,
            initial,
            phase,
            hosts_wait,
            end_request,
            log,
            domain,
            ..
        } = self;
        control.answer_requests(
            run.id(),
            run.path(),
            |request| -> anyhow::Result<Option<ControlResponse>> {
                match request {
                    ControlRequest::Status => Ok(Some(
                        match requests::status(config, run, supervisor, progress, initial) {
                            Ok(status) => ControlResponse::Status(status),
                            Err(error) => ControlResponse::Refused(error.to_string()),
                        },
                    )),
                    ControlRequest::Scale(_) if *phase == Phase::RunEnds => Ok(Some(ControlResponse::RunIsEnding)),
                    ControlRequest::Scale(_) if *phase == Phase::RolesEnd => Ok(Some(ControlResponse::Refused(
                        format!("{ROLES_END}; try again when it continues"),
                    ))),
                    ControlRequest::Scale(request) => requests::scale(config, run, supervisor, &request, now).map(Some),
                    ControlRequest::Admit(_)
                        if *phase == Phase::RunEnds
                            || end_request.is_some_and(|request| request.end.ends_hosts(*hosts_wait)) =>
                    {
                        Ok(Some(ControlResponse::RunIsEnding))
                    }
                    ControlRequest::Admit(_) if *phase == Phase::RolesEnd => {
                        Ok(Some(ControlResponse::NotNow(ROLES_END.into())))
                    }
                    // As when too many files are open.
                    ControlRequest::Admit(request) => Ok(Some(
                        supervisor
                            .admit(domain, request)
                            .unwrap_or_else(|error| ControlResponse::NotNow(one_line(error))),
                    )),
                    ControlRequest::Hosts(statuses) => Ok(Some(supervisor.update_joined_hosts(statuses))),
                    ControlRequest::Replace { .. } | ControlRequest::JoinAgain(_) => {
                        Ok(Some(ControlResponse::Refused("this is the learner's host".into())))
                    }
                    ControlRequest::Stop => {
                        if end_request.is_none() {
                            log.note("launcher", "`shoal stop` ends the run");
                        }
                        end_request.get_or_insert_with(|| EndRequest::new(RunEnd::Stopped));
                        Ok(None)
                    }
                }
            },
        )
    }

    fn sleep(&mut self, most: Duration) {
        if self.supervisor.sleep(self.signals, &self.control, most) {
            self.tick = SHORTEST_TICK;
        }
    }
}

/// Passes all received reports to `handle`. Returns the fraction of one sender's buffer that they would fill.
fn each<R: Report>(reports: &Reports<R>, mut handle: impl FnMut(R) -> anyhow::Result<()>) -> anyhow::Result<f64> {
    let mut count = 0;
    while let Some(report) = reports.receive()? {
        handle(report)?;
        count += 1;
    }
    Ok(f64::from(count) / R::BUFFER as f64)
}

/// Writes the iceoryx2 configuration of the run twice. iceoryx2's own tools find the run's services with the first file
/// if they are started in the run directory. The second is for external environment servers: iceoryx2 cannot read a
/// file at every path that a run may have.
fn write_iox_config(domain: &Domain, run: &RunDir) -> anyhow::Result<()> {
    let text = domain.iox_config()?;
    for file in [run.iceoryx2_config(), server_iceoryx2_config(domain.run_id())?] {
        let write = || {
            file.parent().map_or(Ok(()), std::fs::create_dir_all)?;
            std::fs::write(&file, &text)
        };
        write().with_context(|| format!("cannot write {}", file.display()))?;
    }
    Ok(())
}
