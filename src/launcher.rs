//! The launcher: starts the roles of a run, watches them, writes the records, and ends the roles.

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
mod predecessors;
mod process;
mod progress;
mod requests;
mod shares;
mod stall;
mod supervised_role;
mod supervisor;

use std::time::{Duration, Instant};

use anyhow::Context;
use shoal_common::channel::Domain;
use shoal_common::channel::control::{ControlPort, ControlRequest, ControlResponse, RunStatus};
use shoal_common::channel::reports::{Report, Reports};
use shoal_common::config::{Config, Mode};
use shoal_common::message::one_line;
use shoal_common::report::{EpisodeReport, EvaluationReport, Heartbeat, LearnerReport};
use shoal_common::role::Role;
use shoal_common::run_dir::{LockedRun, RunDir};
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
pub(crate) use self::predecessors::{wait_for_predecessors, wait_for_roles_here};
use self::progress::ProgressLine;
use self::stall::StallDetector;
use self::supervisor::{SupervisedHost, Supervisor};

/// How often the launcher reads reports and checks its children if nothing wakes it. Ticks start short and become
/// longer while reports arrive slowly: a full buffer loses its oldest reports.
const TICK: Duration = Duration::from_millis(500);
const SHORTEST_TICK: Duration = Duration::from_millis(20);

/// If less than this share of a report buffer is filled in a tick, the next tick is longer.
const LOW_FILL: f64 = 0.1;

/// How long the report of the last evaluation may take after the learner is done. The evaluation itself is over by
/// then: the learner waits for it.
const LAST_EVALUATION_TIMEOUT: Duration = Duration::from_secs(1);

/// Why a request that needs roles is refused while the roles end and the run may start new ones.
const ROLES_ARE_ENDING: &str = "the processes of the run are ending";

/// How long the actors of a stopped run may wait for their last chunks to be committed, even while there is no learner.
const ACTORS_HAND_OVER_TIMEOUT: Duration = Duration::from_secs(2);
/// How long actors may take to end after that. In a run that was not stopped, this is all the time they have.
const ACTORS_END_TIMEOUT: Duration = Duration::from_secs(3);
/// How long the other roles may take to end. The learner saves its state in this time.
const OTHERS_END_TIMEOUT: Duration = Duration::from_secs(15);

/// How long the gate may take to let the other hosts hand over their last chunks.
const GATE_END_TIMEOUT: Duration = Duration::from_secs(8);

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
enum EndReason {
    /// The run has ended.
    Run(RunEnd),
    /// The run continues in new shared memory: dead processes occupy the old one permanently, or another program has
    /// removed files of the run.
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
    ended.inspect_err(|error| record_failure_if_open(run, error))
}

/// Records that the run has failed, unless a launcher has recorded how it ended.
fn record_failure_if_open(run: &LockedRun, error: &anyhow::Error) {
    if run.check().is_ok()
        && let Ok(Some(outcome)) = RunOutcome::read(run)
        && outcome.state == RunState::Running
    {
        // No launcher has recorded an end: the run failed before its roles were started, or between two parts of it.
        let state = RunState::Failed;
        let failed = RunOutcome { state, ..outcome }.with_reason(one_line(error));
        // An error here must not hide the original one.
        let _ = failed.write(run);
    }
}

/// Runs all roles. Starts them again in new shared memory whenever that is needed.
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
        if let EndReason::Run(ending) = part.ending {
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
) -> anyhow::Result<TrainingOutcome<EndReason>> {
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

/// What the launcher is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    Running,
    /// It ends the roles, and the run with them. The other hosts end too.
    EndingRun,
    /// It ends the roles, but the other hosts wait: the run has failed, moves to new shared memory, or is to be
    /// resumed.
    EndingRoles,
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
            phase: Phase::Running,
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

    fn run(mut self) -> anyhow::Result<TrainingOutcome<EndReason>> {
        let mut ending = self.watch();
        if let Err(gone) = self.run.check() {
            // The roles can no longer save anything. Another run may be at this path by now, so no role may be started
            // either.
            self.supervisor.kill(|_| true, "had lost the run's directory");
            ending = Err(gone.into());
        }
        // The roles are ended in every case, also after an error.
        self.progress.set_message("ending");
        let ended = self.end_all(ending.as_ref().ok().copied());
        if matches!(ending, Ok(EndReason::Renewal))
            && let Some(request) = self.end_request
        {
            ending = Ok(EndReason::Run(request.end));
        }
        self.progress.clear();
        self.control.answer_waiting(&match (&ended, &ending) {
            // A request to stop came too late.
            (Ok(()), Ok(EndReason::Run(RunEnd::Finished))) => ControlResponse::Refused(in_final_evaluation(self.run)),
            (Ok(()), _) => ControlResponse::Accepted,
            (Err(error), _) => ControlResponse::Refused(format!("{error:#}")),
        });
        // If the directory is gone, all other errors follow from that, and nothing may be written at its path. The open
        // log is still the run's own.
        self.run
            .check()
            .inspect_err(|gone| self.log.note("launcher", &format!("{FAILED}{gone}")))?;
        let renewed = matches!(ending, Ok(EndReason::Renewal));
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
            if ending == EndReason::Renewal {
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
            EndReason::Run(RunEnd::Stopped) => stopped.with_reason("by request".to_owned()).write(self.run)?,
            EndReason::Run(RunEnd::Interrupted(signal)) => {
                stopped.with_reason(format!("signal {signal}")).write(self.run)?
            }
            // The final evaluation of a finished run is still to come.
            EndReason::Run(RunEnd::Finished) | EndReason::Renewal => {}
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

    fn watch(&mut self) -> anyhow::Result<EndReason> {
        self.run.check()?;
        self.supervisor.start_all(self.domain)?;
        loop {
            self.take_signal();
            self.run.check()?;
            self.read_reports()?;
            self.answer_requests()?;
            let condition = match (self.supervisor.maintain(self.domain), self.end_request) {
                // A run that is about to end needs no role that cannot work.
                (Err(_), Some(request)) => return Ok(EndReason::Run(request.end)),
                (condition, _) => condition?,
            };
            match condition {
                supervisor::RunCondition::AtWork => {}
                supervisor::RunCondition::LearnerDone => {
                    self.await_last_evaluation()?;
                    return Ok(EndReason::Run(RunEnd::Finished));
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
                return Ok(EndReason::Run(request.end));
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

    /// Logs and prints why the run continues in new shared memory. Returns [`EndReason::Renewal`].
    fn report_renewal(&self, why: &str) -> EndReason {
        let why = format!("{why}: the run continues in new shared memory");
        self.log.note("launcher", &why);
        self.progress.print(&why);
        EndReason::Renewal
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

    /// Ends all roles, the actors first, so that the learner still receives what they send. If the run is over, the
    /// other hosts are told, even if the request for that comes only while the roles end. They are not told, and wait,
    /// after a failure (`None`), and if the run is renewed or to be resumed.
    fn end_all(&mut self, ending: Option<EndReason>) -> anyhow::Result<()> {
        let hosts_wait = self.hosts_wait;
        self.phase = match ending {
            Some(EndReason::Run(end)) if end.ends_hosts(hosts_wait) => Phase::EndingRun,
            _ => Phase::EndingRoles,
        };
        let was_asked = matches!(ending, Some(EndReason::Run(RunEnd::Stopped | RunEnd::Interrupted(_))));
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
            Some(EndReason::Renewal) => end_request.is_some_and(|request| request.end.ends_hosts(hosts_wait)),
            Some(EndReason::Run(end)) => end.ends_hosts(hosts_wait),
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
            handle_all(&self.episode_reports, |report| {
                Ok(self.recorder.episode(&report, wall)?)
            })?,
            handle_all(&self.evaluation_reports, |report| {
                // A restarted evaluator reports some again.
                let is_new = self.recorder.evaluated() < Some(report.env_steps);
                self.progress.set_evaluation(&report, is_new);
                Ok(self.recorder.evaluation(&report, wall)?)
            })?,
            handle_all(&self.learner_reports, |report| {
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
                let run_ends = end_request.is_some_and(|request| request.end.ends_hosts(*hosts_wait));
                if let Some(answer) = answer_while_ending(*phase, run_ends, &request) {
                    return Ok(Some(answer));
                }
                match request {
                    ControlRequest::Status => Ok(Some(
                        match requests::status(config, run, supervisor, progress, initial) {
                            Ok(status) => ControlResponse::Status(status),
                            Err(error) => ControlResponse::Refused(error.to_string()),
                        },
                    )),
                    ControlRequest::Scale(request) => requests::scale(config, run, supervisor, &request, now).map(Some),
                    // The launcher may be able to admit the host later, for example when fewer files are open.
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

/// The answer to a request that must not be carried out while the roles end; `None` if it may be. `run_ends` is whether
/// the run was asked to end, and the other hosts end with it.
fn answer_while_ending(phase: Phase, run_ends: bool, request: &ControlRequest) -> Option<ControlResponse> {
    match (request, phase) {
        (ControlRequest::Scale(_) | ControlRequest::Admit(_), Phase::EndingRun) => Some(ControlResponse::RunIsEnding),
        (ControlRequest::Admit(_), _) if run_ends => Some(ControlResponse::RunIsEnding),
        (ControlRequest::Scale(_), Phase::EndingRoles) => Some(ControlResponse::Refused(format!(
            "{ROLES_ARE_ENDING}; try again when it continues"
        ))),
        (ControlRequest::Admit(_), Phase::EndingRoles) => Some(ControlResponse::NotNow(ROLES_ARE_ENDING.into())),
        _ => None,
    }
}

/// Passes all received reports to `handle`. Returns their number as a share of one sender's buffer.
fn handle_all<R: Report>(reports: &Reports<R>, mut handle: impl FnMut(R) -> anyhow::Result<()>) -> anyhow::Result<f64> {
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

#[cfg(test)]
mod tests {
    use shoal_common::channel::control::{HostRequest, ScaleRequest};

    use super::*;

    #[test]
    fn while_the_roles_end_nothing_is_done_that_needs_them() {
        let scale = ControlRequest::Scale(ScaleRequest::default());
        let admit = ControlRequest::Admit(HostRequest {
            host: 7,
            name: "node".into(),
            actors: 1,
            cores: 1,
            held: Vec::new(),
        });
        let is_ending = Some(ControlResponse::RunIsEnding);
        for request in [&scale, &admit] {
            assert_eq!(answer_while_ending(Phase::Running, false, request), None);
            assert_eq!(answer_while_ending(Phase::EndingRun, false, request), is_ending);
        }
        assert_eq!(answer_while_ending(Phase::Running, true, &scale), None);
        for phase in [Phase::Running, Phase::EndingRun, Phase::EndingRoles] {
            assert_eq!(answer_while_ending(phase, true, &admit), is_ending);
        }
        let not_now = answer_while_ending(Phase::EndingRoles, false, &admit);
        assert!(matches!(not_now, Some(ControlResponse::NotNow(_))), "{not_now:?}");
        let refused = answer_while_ending(Phase::EndingRoles, true, &scale);
        assert!(matches!(refused, Some(ControlResponse::Refused(_))), "{refused:?}");
        for request in [ControlRequest::Status, ControlRequest::Stop] {
            assert_eq!(answer_while_ending(Phase::EndingRun, true, &request), None);
        }
    }
}
