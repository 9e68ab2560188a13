//! The launcher: starts the roles of a run, watches them, keeps the records, and ends all of them.

mod child;
mod cleaner;
mod incarnations;
mod log;
mod process;
mod progress;
mod requests;
mod stall;
mod supervisor;

use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use anyhow::Context;
use shoal_common::channel::control::{Answer, ControlPort, Question, RunStatus};
use shoal_common::channel::reports::{Report, Reports};
use shoal_common::channel::{Domain, DomainError};
use shoal_common::config::Config;
use shoal_common::report::{EpisodeReport, EvaluationReport, Heartbeat, LearnerReport, Role};
use shoal_common::run_dir::RunDir;
use shoal_common::stop::GRACE;
use shoal_run::outcome::{RunOutcome, RunState};
use shoal_run::process::wait_for_any;
use shoal_run::recorder::Recorder;
use shoal_run::signals::Signals;
use shoal_run::{preflight, status};

pub(crate) use self::cleaner::work as clean_up;
use self::log::Log;
pub(crate) use self::log::{EVERYBODY_ENDED, FAILED};
use self::progress::Progress;
use self::stall::Stalls;
use self::supervisor::Supervisor;

/// How often the launcher reads reports and looks round where nothing wakes it. It begins with the shortest tick, and a tick is
/// longer than the one before where reports come slowly: the oldest of a full buffer are lost.
const TICK: Duration = Duration::from_millis(500);
const SHORTEST_TICK: Duration = Duration::from_millis(20);

/// How full a buffer of reports may become in a tick that is followed by a longer one.
const SLOWLY: f64 = 0.1;

/// How long the last evaluation's report may take once the learner, which has waited for it, is through.
const LAST_EVALUATION: Duration = Duration::from_secs(1);

/// How long a learner may take to come back when the run is to end.
const LEARNER_BACK: Duration = Duration::from_secs(5);

/// How long actors may take to hand over their last chunks, and the others to end; the learner saves its state.
const ACTORS_END: Duration = Duration::from_secs(3);
const OTHERS_END: Duration = Duration::from_secs(15);

/// How long the roles of a launcher that was killed may take to end: one that is stuck ends after [`GRACE`].
const PREDECESSORS_END: Duration = GRACE.saturating_add(Duration::from_secs(5));

/// How often the run's shared memory may be made anew without an hour between.
const RENEWALS: usize = 5;
const HOUR: Duration = Duration::from_secs(3600);

/// How a run came to its end.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Ending {
    /// All its steps are taken and learned from.
    Finished,
    /// As somebody asked for; the learner saved its state.
    Stopped,
    /// By this signal; the learner saved its state.
    Interrupted(i32),
    /// Dead processes occupy places in shared memory that cannot be freed: it goes on in shared memory that is made anew.
    Renewed,
}

/// What is known of a run when it ends.
#[derive(Clone, Debug)]
pub(crate) struct TrainingOutcome {
    pub(crate) ending: Ending,
    pub(crate) wall: Duration,
    /// How the run stood when it began, and how it stands now.
    pub(crate) before: RunStatus,
    pub(crate) after: RunStatus,
}

/// Runs all roles until the learner is through, a signal comes, or somebody asks for the end.
pub(crate) fn run(mut config: Config, run: &RunDir, signals: &Signals, quiet: bool) -> anyhow::Result<TrainingOutcome> {
    let (mut renewals, mut before, mut wall) = (Vec::new(), None, Duration::ZERO);
    loop {
        let outcome = run_once(config, run, signals, quiet)?;
        wall += outcome.wall;
        let before = before.get_or_insert(outcome.before.clone());
        if outcome.ending != Ending::Renewed {
            let before = before.clone();
            return Ok(TrainingOutcome {
                before,
                wall,
                ..outcome
            });
        }
        renewals.retain(|then: &Instant| then.elapsed() < HOUR);
        renewals.push(Instant::now());
        if renewals.len() > RENEWALS {
            anyhow::bail!("the run's shared memory had to be made anew {RENEWALS} times within an hour");
        }
        // It may have been scaled.
        config = run.config()?;
    }
}

fn run_once(config: Config, run: &RunDir, signals: &Signals, quiet: bool) -> anyhow::Result<TrainingOutcome> {
    Domain::wait_for_the_last(&config.run.id, PREDECESSORS_END).map_err(|error| explain(error, run))?;
    Domain::remove_abandoned()?;
    let domain = Domain::join(&config.run.id, config.actors.max)?;
    let outcome = preflight::claim(&config, run, &domain)
        .and_then(|()| Launcher::new(config, run, &domain, signals, quiet))
        .and_then(Launcher::run);
    // Even where something failed: no role is left by now.
    let left = domain.leave();
    let outcome = outcome?;
    left?;
    Ok(outcome)
}

/// Says whose processes they are that keep a run from beginning.
fn explain(error: DomainError, run: &RunDir) -> anyhow::Error {
    let DomainError::StillAlive { pids, .. } = &error else {
        return error.into();
    };
    // A role's arguments are its name, the run's directory, and two numbers; a launcher's are what somebody typed.
    let roles = [Role::EnvServer, Role::Actor, Role::Evaluator, Role::Learner].map(Role::name);
    let directory = |pid: &i32| {
        let arguments = std::fs::read(format!("/proc/{pid}/cmdline")).ok()?;
        let arguments = String::from_utf8_lossy(&arguments);
        let mut arguments = arguments.split('\0').skip(1);
        let is_role = roles.contains(&arguments.next()?);
        arguments.next().filter(|_| is_role).map(str::to_owned)
    };
    let here = run.path().display();
    match pids
        .iter()
        .find_map(directory)
        .filter(|there| *there != here.to_string())
    {
        Some(there) => anyhow::anyhow!("{here} is a copy of {there}, which is going on: end that one first"),
        None => error.into(),
    }
}

struct Launcher<'a> {
    config: Config,
    run: &'a RunDir,
    domain: &'a Domain,
    control: ControlPort,
    /// How the run stood when this launcher began.
    rest: RunStatus,
    /// When somebody asked for the end first.
    to_end: Option<Instant>,
    /// The end has begun.
    ends: bool,
    supervisor: Supervisor,
    log: Log,
    recorder: Recorder,
    progress: Progress,
    signals: &'a Signals,
    stalls: Stalls,
    begun: Instant,
    tick: Duration,
    heartbeats: Reports<Heartbeat>,
    episode_reports: Reports<EpisodeReport>,
    evaluation_reports: Reports<EvaluationReport>,
    learner_reports: Reports<LearnerReport>,
}

impl<'a> Launcher<'a> {
    fn new(
        config: Config,
        run: &'a RunDir,
        domain: &'a Domain,
        signals: &'a Signals,
        quiet: bool,
    ) -> anyhow::Result<Self> {
        let log = Log::open(&run.log())?;
        write_iox_config(domain, run)?;
        std::fs::create_dir_all(run.checkpoints()).context("cannot make the directory for checkpoints")?;
        if config.evaluation.keep_policies {
            std::fs::create_dir_all(run.policies()).context("cannot make the directory for policies")?;
        }
        let recorder = Recorder::open(run, config.replay.warmup)?;
        let rest = status::at_rest(&config, run)?;
        RunOutcome::new(RunState::Running, rest.env_steps, rest.episodes).write(run)?;
        // Makes the services that are opened below.
        let supervisor = Supervisor::new(&config, run, domain, log.clone())?;
        Ok(Self {
            control: ControlPort::open(domain)?,
            rest,
            to_end: None,
            ends: false,
            run,
            domain,
            heartbeats: Reports::open(domain)?,
            episode_reports: Reports::open(domain)?,
            evaluation_reports: Reports::open(domain)?,
            learner_reports: Reports::open(domain)?,
            supervisor,
            stalls: Stalls::new(Duration::from_secs(config.run.stall_seconds)),
            log,
            recorder,
            progress: Progress::new(&config, run, quiet),
            config,
            signals,
            begun: Instant::now(),
            tick: SHORTEST_TICK,
        })
    }

    fn run(mut self) -> anyhow::Result<TrainingOutcome> {
        let ending = self.watch();
        // Whatever happened, nobody is left behind.
        self.progress.say("ending");
        let ended = self.end_everyone();
        self.progress.clear();
        self.control.dismiss(&match &ended {
            Ok(()) => Answer::Accepted,
            Err(error) => Answer::Refused(format!("{error:#}")),
        });
        let renewed = matches!(ending, Ok(Ending::Renewed));
        let failure = ending.as_ref().err().or(ended.as_ref().err().filter(|_| !renewed));
        if let Some(error) = failure {
            let why = format!("{error:#}").replace('\n', " ");
            self.log.note("launcher", &format!("{FAILED}{why}"));
            // The error itself is what is to be told.
            let _ = self
                .outcome(RunState::Failed)
                .map(|outcome| outcome.because(why).write(self.run));
        }
        let ending = ending?;
        // Where shared memory is made anew, the learner goes on from its newest checkpoint.
        ended.or_else(|error| if ending == Ending::Renewed { Ok(()) } else { Err(error) })?;
        self.recorder.flush()?;
        // What the learner saved: its last report may have come too late to be heard.
        let after = status::at_rest(&self.config, self.run)?;
        let stopped = RunOutcome::new(RunState::Stopped, after.env_steps, after.episodes);
        match ending {
            Ending::Stopped => stopped.because("somebody asked for it").write(self.run)?,
            Ending::Interrupted(signal) => stopped.because(format!("signal {signal}")).write(self.run)?,
            // A finished run is still to be evaluated.
            Ending::Finished | Ending::Renewed => {}
        }
        Ok(TrainingOutcome {
            ending,
            wall: self.begun.elapsed(),
            after,
            before: self.rest,
        })
    }

    fn outcome(&self, state: RunState) -> anyhow::Result<RunOutcome> {
        let rest = status::at_rest(&self.config, self.run)?;
        Ok(RunOutcome::new(state, rest.env_steps, rest.episodes))
    }

    fn watch(&mut self) -> anyhow::Result<Ending> {
        self.supervisor.start_all(self.domain)?;
        loop {
            if let Some(signal) = self.signals.received() {
                return Ok(Ending::Interrupted(signal));
            }
            self.read_reports()?;
            self.attend()?;
            match self.supervisor.look_after(self.domain)? {
                supervisor::Situation::AtWork => {}
                supervisor::Situation::LearnerDone => {
                    self.await_last_evaluation()?;
                    return Ok(Ending::Finished);
                }
                supervisor::Situation::SharedMemoryOccupied if self.to_end.is_some() => {}
                supervisor::Situation::SharedMemoryOccupied => {
                    let why =
                        "dead processes occupy places in shared memory: the run goes on in shared memory made anew";
                    self.log.note("launcher", why);
                    self.progress.note(why);
                    return Ok(Ending::Renewed);
                }
            }
            for stalled in self.supervisor.replace_stalled(&mut self.stalls) {
                self.log.note("launcher", &stalled);
                self.progress.note(&stalled);
            }
            // A learner that has just died shall come back and take in what was sent, before everybody ends.
            let may_end = |asked: Instant| self.supervisor.has_learner() || asked.elapsed() >= LEARNER_BACK;
            if self.to_end.is_some_and(may_end) {
                return Ok(Ending::Stopped);
            }
            self.progress.draw(&self.supervisor);
            self.sleep(self.tick.min(self.supervisor.idle_for()));
        }
    }

    /// Sleeps until a process ends, a signal comes or somebody asks, but no longer than `most`.
    fn sleep(&mut self, most: Duration) {
        let mut wakers: Vec<_> = self.supervisor.ends().collect();
        wakers.extend([self.signals.as_fd(), self.control.as_fd()]);
        if wait_for_any(&wakers, most) {
            self.tick = SHORTEST_TICK;
        }
        // What it has woken for is not to wake it again.
        self.signals.received();
        self.supervisor.see_ends();
    }

    /// Answers who asks from another terminal. Who asks for the end is answered when it is there.
    fn attend(&mut self) -> anyhow::Result<()> {
        let Self {
            config,
            run,
            control,
            supervisor,
            progress,
            rest,
            ends,
            to_end,
            ..
        } = self;
        control.attend(run.key()?, run.path(), |question| -> anyhow::Result<Option<Answer>> {
            match question {
                Question::Status => Ok(Some(match requests::status(config, run, supervisor, progress, rest) {
                    Ok(status) => Answer::Status(status),
                    Err(error) => Answer::Refused(error.to_string()),
                })),
                Question::Scale { .. } if *ends => Ok(Some(Answer::Refused("the run is ending".into()))),
                Question::Scale { actors } => requests::scale(config, run, supervisor, actors).map(Some),
                Question::Stop => {
                    to_end.get_or_insert_with(Instant::now);
                    Ok(None)
                }
            }
        })
    }

    /// The evaluator may still be at the policy of the last period.
    fn await_last_evaluation(&mut self) -> anyhow::Result<()> {
        let last = status::at_rest(&self.config, self.run)?.env_steps;
        let patience = Instant::now();
        while patience.elapsed() < LAST_EVALUATION && self.signals.received().is_none() {
            self.read_reports()?;
            self.attend()?;
            let period = |steps| self.config.evaluation.period(steps);
            if self.recorder.evaluated().map(period) >= Some(period(last)) {
                break;
            }
            self.sleep(SHORTEST_TICK);
        }
        Ok(())
    }

    /// Ends everyone: the actors first, so that the learner still takes what they send.
    fn end_everyone(&mut self) -> anyhow::Result<()> {
        self.ends = true;
        let actors = |role| role == Role::Actor;
        self.end(actors, ACTORS_END);
        self.end(|_| true, OTHERS_END);
        self.read_reports()?;
        self.supervisor.check_saved()
    }

    fn end(&mut self, which: impl Fn(Role) -> bool + Copy, patience: Duration) {
        let deadline = Instant::now() + patience;
        self.supervisor.ask_to_end(which);
        while !self.supervisor.have_ended(which) {
            if Instant::now() >= deadline {
                self.supervisor.kill(which);
            }
            // No question keeps a run from ending.
            let _ = self.attend();
            self.sleep(deadline.saturating_duration_since(Instant::now()).min(TICK));
        }
    }

    fn read_reports(&mut self) -> anyhow::Result<()> {
        let wall = self.begun.elapsed();
        while let Some(heartbeat) = self.heartbeats.receive()? {
            self.supervisor.hear(&heartbeat);
        }
        for incident in self.supervisor.take_incidents() {
            self.recorder.incident(&incident, wall)?;
        }
        self.supervisor.check_faults(self.config.environment.faults)?;
        let filled = [
            each(&self.episode_reports, |report| {
                Ok(self.recorder.episode(&report, wall)?)
            })?,
            each(&self.evaluation_reports, |report| {
                self.progress.heard_evaluation(&report);
                Ok(self.recorder.evaluation(&report, wall)?)
            })?,
            each(&self.learner_reports, |report| {
                self.progress.heard_learner(&report, wall);
                Ok(self.recorder.learner(&report, wall)?)
            })?,
        ];
        self.tick = match filled.into_iter().fold(0.0, f64::max) {
            0.0..=SLOWLY => (self.tick * 3 / 2).min(TICK),
            filled => self.tick.mul_f64(SLOWLY / filled).max(SHORTEST_TICK),
        };
        Ok(())
    }
}

/// Uses all reports that are there; how full one sender's buffer would be with them.
fn each<R: Report>(reports: &Reports<R>, mut use_it: impl FnMut(R) -> anyhow::Result<()>) -> anyhow::Result<f64> {
    let mut count = 0;
    while let Some(report) = reports.receive()? {
        use_it(report)?;
        count += 1;
    }
    Ok(f64::from(count) / R::BUFFER as f64)
}

/// With this file, iceoryx2's own tools find the run's services when they are started in the run directory, and so do
/// environment servers that are programs of their own.
fn write_iox_config(domain: &Domain, run: &RunDir) -> anyhow::Result<()> {
    let file = run.iceoryx2_config();
    file.parent().map_or(Ok(()), std::fs::create_dir_all)?;
    std::fs::write(file, domain.iox_config()?)?;
    Ok(())
}
