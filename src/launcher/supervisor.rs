//! All processes of a run: starts them, tracks which are ready, restarts them, and gives up those that cannot work.

mod actors;
mod admission;
mod cleaning;
mod ending;
mod faults;

use std::os::fd::AsFd;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use anyhow::anyhow;
use shoal_common::channel::control::{ControlPort, RoleStatus, RunDirId};
use shoal_common::channel::{Domain, Services};
use shoal_common::config::{Config, Mode};
use shoal_common::report::Heartbeat;
use shoal_common::role::{Activity, Role, RoleInstance};
use shoal_common::run_dir::RunDir;
use shoal_run::child_process::{OutputSource, wait_for_any};
use shoal_run::records::recorder::{Incident, IncidentKind};
use shoal_run::signals::Signals;
use tracing_subscriber::filter::LevelFilter;

use self::actors::ActorSet;
use self::cleaning::Cleaning;
use self::faults::Faults;
use super::incarnations::Incarnations;
use super::joined_hosts::JoinedHosts;
use super::local_actors;
use super::log::Log;
use super::process::{Process, describe_exit, name};
use super::stall::StallDetector;
use super::supervised_role::{RestartDecision, SupervisedRole};
use crate::log_level::log_level;

/// A start that takes longer is reported to the user.
const SLOW_START: Duration = Duration::from_secs(10);

/// The situation of the run's processes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RunCondition {
    AtWork,
    LearnerDone,
    /// Dead processes occupy shared memory that cannot be freed.
    SharedMemoryOccupied,
    /// Another program has removed files with which the processes find each other.
    FilesRemoved,
}

/// The supervised host. It determines which processes there are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum SupervisedHost {
    /// The learner's host, with a gate if other hosts may join.
    OfLearner {
        /// Whether there is a gate.
        gate: bool,
    },
    /// A joined host: a relay, and these actors with their environment servers.
    Joined {
        /// The actors.
        actors: Vec<u32>,
    },
}

/// All processes of a run on one host.
#[derive(Debug)]
pub(super) struct Supervisor {
    roles: Vec<SupervisedRole>,
    services: Services,
    /// Whether the learner is on this host.
    is_learner_host: bool,
    window: u32,
    cleaning: Cleaning,
    actors: ActorSet,
    joined_hosts: JoinedHosts,
    log: Log,
    /// Incidents since the last [`Supervisor::take_incidents`].
    incidents: Vec<Incident>,
    run: PathBuf,
    /// Which directory was at that path.
    directory: RunDirId,
    /// Whose output the environment servers write. With `SHOAL_LOG=debug` it counts as Shoal's own, so that all of it
    /// is logged.
    server_output: OutputSource,
    /// How long an environment's own program may take to start.
    server_start_limit: Option<Duration>,
    incarnations: Incarnations,
    faults: Faults,
    /// A role is given up if its failures span this time.
    give_up_after: Duration,
    all_ready: bool,
    learner_done: bool,
    /// How the learner ended, if it ended without saving its state.
    unsaved_learner: Option<String>,
}

impl Supervisor {
    pub(super) fn new(
        config: &Config,
        run: &RunDir,
        domain: &Domain,
        log: Log,
        host: SupervisedHost,
    ) -> anyhow::Result<Self> {
        let incarnations = Incarnations::open(run, &log)?;
        let is_learner_host = matches!(host, SupervisedHost::OfLearner { .. });
        let mut services = Services::new(domain)?;
        services.create_common(domain)?;
        if is_learner_host && config.actors_that_share() > 0 {
            services.create_shared_transitions(domain, config.actors_that_share(), config.actors.window)?;
        }
        let server = config.evaluation_server();
        let lockstep = config.run.mode == Mode::Lockstep;
        let mut lockstep_actors = None;
        let (roles, actors) = match host {
            SupervisedHost::OfLearner { gate } => {
                services.create_environment(domain, server)?;
                let mut roles = vec![
                    SupervisedRole::new(Role::Learner, 0),
                    SupervisedRole::new(Role::EnvServer, server),
                    SupervisedRole::new(Role::Evaluator, 0).with_server(server),
                ];
                roles.extend(gate.then(|| SupervisedRole::new(Role::Gate, 0)));
                lockstep_actors = lockstep.then_some(config.actors.count);
                let count = config.actors.count;
                let actors = match lockstep {
                    true => (0..count).collect(),
                    false => {
                        let actors = local_actors::read(run, count, config.actors.max_on_a_host())?;
                        local_actors::write(run, &actors)?;
                        actors
                    }
                };
                (roles, actors)
            }
            SupervisedHost::Joined { actors } => (vec![SupervisedRole::new(Role::Relay, 0)], actors),
        };
        Ok(Self {
            roles,
            services,
            is_learner_host,
            window: config.actors.window,
            cleaning: Cleaning::new(),
            actors: ActorSet::new(actors, lockstep_actors, &config.actors),
            joined_hosts: JoinedHosts::new(incarnations.last(), Duration::from_secs_f64(config.remote.lost_seconds)),
            log,
            incidents: Vec::new(),
            run: run.path().into(),
            directory: run.directory_id()?,
            server_output: match log_level() {
                LevelFilter::DEBUG | LevelFilter::TRACE => OutputSource::Shoal,
                _ if !config.environment.is_external() => OutputSource::Shoal,
                _ => OutputSource::Program,
            },
            server_start_limit: config
                .environment
                .is_external()
                .then(|| config.environment.start_limit()),
            incarnations,
            faults: Faults {
                count: 0,
                most: config.environment.faults,
                last: String::new(),
            },
            give_up_after: Duration::from_secs(config.run.give_up_seconds),
            all_ready: false,
            learner_done: false,
            unsaved_learner: None,
        })
    }

    /// Starts all processes.
    pub(super) fn start_all(&mut self, domain: &Domain) -> anyhow::Result<()> {
        self.create_wanted_services(domain)?;
        self.incarnations
            .reserve((self.roles.len() + self.missing().len()) as u64)?;
        (0..self.roles.len()).try_for_each(|i| self.start(i).map(drop))?;
        self.start_missing(domain)
    }

    /// The incidents since the last call, in order.
    pub(super) fn take_incidents(&mut self) -> Vec<Incident> {
        std::mem::take(&mut self.incidents)
    }

    /// Starts a role's process. If the system refuses to, as it does while there are too many processes or open files,
    /// it is tried again later. Returns whether there is a process.
    ///
    /// # Errors
    /// When the system has refused for too long.
    fn start(&mut self, i: usize) -> anyhow::Result<bool> {
        match self.start_now(i) {
            Ok(()) => Ok(true),
            Err(error) => self.handle_refused_start(i, error).map(|()| false),
        }
    }

    /// Starts a role's process.
    ///
    /// # Errors
    /// When the counter of incarnations cannot be written, or the system refuses.
    fn start_now(&mut self, i: usize) -> anyhow::Result<()> {
        let incarnation = self.incarnations.take(1)?;
        let supervised = &mut self.roles[i];
        supervised.instance.incarnation = incarnation;
        let source = match supervised.instance.role {
            Role::EnvServer => self.server_output,
            _ => OutputSource::Shoal,
        };
        let process = Process::start(supervised.instance, &self.run, &self.log, source)?;
        self.log.note(
            &name(supervised.instance),
            &format!("started as process {}", process.pid()),
        );
        supervised.begin(process);
        Ok(())
    }

    fn handle_refused_start(&mut self, i: usize, error: anyhow::Error) -> anyhow::Result<()> {
        let supervised = &mut self.roles[i];
        let name = name(supervised.instance);
        match supervised.handle_refused_start(self.give_up_after) {
            RestartDecision::Restart(pause) => {
                supervised.restart_at = Instant::now() + pause;
                self.log.note(&name, &format!("{error:#}; trying again in {pause:?}"));
                Ok(())
            }
            RestartDecision::GiveUp(failures) => {
                self.note_incident(i, IncidentKind::GivenUp, String::new());
                Err(error.context(format!("{name} is given up after {failures} failures")))
            }
        }
    }

    /// Starts the gate again if it has just died and other hosts are waiting for news. Returns whether it was started.
    ///
    /// # Errors
    /// When it cannot be started.
    pub(super) fn ensure_gate(&mut self, domain: &Domain) -> anyhow::Result<bool> {
        Ok(!self.joined_hosts.leases().is_empty() && self.restart_if_dead(Role::Gate, domain)?)
    }

    /// Restarts the only process of a role if it has died; a learner only if it had not finished. Returns whether it was
    /// restarted.
    ///
    /// # Errors
    /// When it cannot be started.
    pub(super) fn restart_if_dead(&mut self, role: Role, domain: &Domain) -> anyhow::Result<bool> {
        self.reap(|which| which == role);
        let is_dead = |supervised: &SupervisedRole| supervised.is(role, 0) && supervised.process.is_none();
        let Some(i) = self.roles.iter().position(is_dead) else {
            return Ok(false);
        };
        // If files of the run are missing, the clean-up and the new process would find those of another run, or none.
        if role == Role::Learner && self.learner_done || !domain.is_intact(self.services.count()) {
            return Ok(false);
        }
        if let Some(status) = self.roles[i].ended.take() {
            self.log.note(
                &name(self.roles[i].instance),
                &format!("{}; restarting it", describe_exit(status)),
            );
            self.note_incident(i, kind_of_end(status), describe_exit(status));
        }
        self.cleaning.clean(domain, &self.services, &self.log);
        self.start_now(i)?;
        self.roles[i].restarts += 1;
        if role == Role::Learner {
            self.unsaved_learner = None;
        }
        self.note_incident(i, IncidentKind::Restarted, String::new());
        Ok(true)
    }

    /// Records a heartbeat.
    pub(super) fn record(&mut self, heartbeat: &Heartbeat) {
        let supervised = self.roles.iter_mut().find(|it| {
            let RoleInstance {
                role,
                index,
                incarnation,
            } = it.instance;
            (heartbeat.role(), heartbeat.index, heartbeat.incarnation) == (Some(role), index, incarnation)
        });
        let Some(supervised) = supervised else { return };
        let faults = heartbeat.faults.saturating_sub(supervised.faults());
        let (client, server) = (name(supervised.instance), supervised.server());
        if let Some(after) = supervised.record(heartbeat) {
            self.log.note(
                &name(supervised.instance),
                &format!("ready after {} ms", after.as_millis()),
            );
        }
        if let Some(index) = server {
            // A heartbeat may claim any number.
            (0..faults.min(self.faults.most)).for_each(|_| self.note_fault(&client, index));
        }
        if !self.all_ready && self.roles.iter().all(SupervisedRole::is_ready) {
            self.all_ready = true;
            self.log.note("launcher", "every role is ready");
        }
    }

    /// The activity of a role: that of its first process with a heartbeat.
    pub(super) fn activity(&self, role: Role) -> Option<Activity> {
        let mut of_role = self.roles.iter().filter(|it| it.instance.role == role);
        of_role.find_map(SupervisedRole::activity)
    }

    /// Whether the only process of this role runs and is ready.
    pub(super) fn is_ready(&self, role: Role) -> bool {
        let mut roles = self.roles.iter();
        roles.any(|it| it.is(role, 0) && it.process.is_some() && it.is_ready())
    }

    /// Total number of restarts.
    pub(super) fn restarts(&self) -> u32 {
        self.roles.iter().map(|it| it.restarts).sum()
    }

    /// The status of all processes. `newest` is the version of the learner's newest policy.
    pub(super) fn status(&self, newest: u64) -> Vec<RoleStatus> {
        let mut roles: Vec<_> = self.roles.iter().collect();
        roles.sort_by_key(|it| (std::cmp::Reverse(it.instance.role), it.instance.index));
        roles.into_iter().map(|it| it.status(newest)).collect()
    }

    /// Sleeps at most `most`, until a process ends, a signal arrives or a request comes. Returns whether one of them
    /// has happened.
    pub(super) fn sleep(&mut self, signals: &Signals, control: &ControlPort, most: Duration) -> bool {
        let exits = self
            .roles
            .iter()
            .filter_map(|it| it.process.as_ref()?.exit_descriptor());
        let wakers: Vec<_> = exits.chain([signals.as_fd(), control.as_fd()]).collect();
        let woken = wait_for_any(&wakers, most);
        // So that the same events do not wake it again.
        signals.received();
        self.collect_exits();
        woken
    }

    /// The time until the next restart or clean-up, unless a process ends earlier.
    pub(super) fn time_to_next_task(&self) -> Duration {
        let missing = |supervised: &&SupervisedRole| supervised.process.is_none() && self.actors.is_wanted(supervised);
        let now = Instant::now();
        let restarts = self.roles.iter().filter(missing);
        restarts
            .map(|it| it.restart_at.saturating_duration_since(now))
            .fold(self.cleaning.time_to_next(), Duration::min)
    }

    /// Collects the exit statuses of ended processes. Their last reports are read before [`maintain`](Self::maintain)
    /// handles the ends.
    fn collect_exits(&mut self) {
        for supervised in self.roles.iter_mut().filter(|it| it.ended.is_none()) {
            supervised.ended = supervised.process.as_mut().and_then(Process::exit_status);
        }
    }

    /// Handles collected ends, restarts processes that are due, and starts or retires actors.
    pub(super) fn maintain(&mut self, domain: &Domain) -> anyhow::Result<RunCondition> {
        let ended = self.roles.iter().any(|it| it.ended.is_some());
        // Checked before anything is cleaned up or started: without the run's files, both would find those of another
        // run, or none.
        if (ended || self.cleaning.is_due()) && !self.learner_has_finished() && !domain.is_intact(self.services.count())
        {
            return Ok(RunCondition::FilesRemoved);
        }
        let can_be_freed = if ended {
            // For the successors of those that have ended.
            self.cleaning.clean(domain, &self.services, &self.log)
        } else {
            !self.cleaning.is_due() || self.cleaning.clean_if_needed(domain, &self.services, &self.log)
        };
        for i in 0..self.roles.len() {
            if self.maintain_one(i)? {
                return Ok(RunCondition::LearnerDone);
            }
        }
        self.retire_surplus();
        self.start_missing(domain)?;
        Ok(if can_be_freed {
            RunCondition::AtWork
        } else {
            RunCondition::SharedMemoryOccupied
        })
    }

    fn learner(&self) -> Option<&SupervisedRole> {
        self.roles.iter().find(|it| it.instance.role == Role::Learner)
    }

    /// Whether the learner's end has been observed, and it was the planned one.
    fn learner_has_finished(&self) -> bool {
        let ended = self.learner().and_then(|learner| learner.ended);
        ended.is_some_and(|status| status.success())
    }

    /// Returns whether this is the learner, and it is done.
    fn maintain_one(&mut self, i: usize) -> anyhow::Result<bool> {
        if let Some(status) = self.roles[i].ended.take()
            && self.handle_end(i, status)?
        {
            return Ok(true);
        }
        let is_wanted = self.actors.is_wanted(&self.roles[i]);
        let supervised = &mut self.roles[i];
        if supervised.process.is_none() && is_wanted && Instant::now() >= supervised.restart_at {
            // A process that retired and is wanted again did not fail: this start is no restart.
            let restarts = supervised.restarts + u32::from(!supervised.is_retiring);
            if self.start(i)? {
                self.roles[i].restarts = restarts;
                self.note_incident(i, IncidentKind::Restarted, String::new());
            }
        }
        Ok(false)
    }

    /// Returns whether this is the learner, and it is done.
    fn handle_end(&mut self, i: usize, status: ExitStatus) -> anyhow::Result<bool> {
        let supervised = &mut self.roles[i];
        let name = name(supervised.instance);
        self.log.write_left_out(&name);
        if supervised.instance.role == Role::Learner && status.success() {
            supervised.process = None;
            self.learner_done = true;
            self.log.note(&name, "done");
            return Ok(true);
        }
        if supervised.is_retiring {
            supervised.process = None;
            supervised.restart_at = Instant::now();
            self.log.note(&name, &format!("retired: {}", describe_exit(status)));
            self.note_incident(i, IncidentKind::Retired, String::new());
            return Ok(false);
        }
        let decision = supervised.handle_end(status, self.give_up_after);
        self.note_incident(i, kind_of_end(status), describe_exit(status));
        match decision {
            RestartDecision::Restart(pause) => {
                self.roles[i].restart_at = Instant::now() + pause;
                let when = if pause.is_zero() {
                    "at once".to_owned()
                } else {
                    format!("in {pause:?}")
                };
                self.log
                    .note(&name, &format!("{}; restarting it {when}", describe_exit(status)));
                Ok(false)
            }
            RestartDecision::GiveUp(failures) => {
                self.note_incident(i, IncidentKind::GivenUp, String::new());
                Err(self.give_up_error(&name, failures, status))
            }
        }
    }

    /// Replaces stalled processes, and reports slow ones. Returns a message for each, which is also in the log.
    pub(super) fn check_progress(&mut self, stalls: &mut StallDetector) -> Vec<String> {
        let mut messages = self.replace_stalled(stalls);
        messages.extend(self.report_slow(stalls));
        for message in &messages {
            self.log.note("launcher", message);
        }
        messages
    }

    /// Kills stalled processes, so that they are replaced. Returns a message for each.
    fn replace_stalled(&mut self, stalls: &mut StallDetector) -> Vec<String> {
        let stalled = stalls.find(&mut self.roles, self.cleaning.take_time());
        let mut messages = Vec::new();
        for (i, why) in stalled {
            let supervised = &mut self.roles[i];
            messages.push(format!(
                "{} makes no progress: {why}; it is replaced",
                name(supervised.instance)
            ));
            if let Some(process) = &mut supervised.process {
                process.kill();
            }
            self.note_incident(i, IncidentKind::Stalled, why.into());
        }
        messages
    }

    /// Messages about slow processes, one for each: environment servers in one step or reset, and roles that are
    /// starting. An environment's program that is not ready in time is ended, which counts as a failure.
    fn report_slow(&mut self, stalls: &StallDetector) -> Vec<String> {
        let mut said = Vec::new();
        for (i, silent) in stalls.slow_servers(&self.roles) {
            let supervised = &mut self.roles[i];
            if supervised.mark_reported_slow() {
                let (name, seconds) = (name(supervised.instance), silent.as_secs());
                said.push(format!(
                    "{name} has spent {seconds} s in one step or reset of its environments; it is not interrupted"
                ));
            }
        }
        for supervised in &mut self.roles {
            let Some(starting) = supervised.starting_for() else {
                continue;
            };
            let limit = self
                .server_start_limit
                .filter(|_| supervised.instance.role == Role::EnvServer);
            if limit.is_some_and(|limit| starting >= limit) {
                let text = "is not ready within environment.start_seconds and is ended";
                self.log.note(&name(supervised.instance), text);
                supervised.kill_slow_start();
            } else if starting >= SLOW_START && supervised.mark_reported_slow() {
                let limit = limit.map_or(String::new(), |limit| format!(", for at most {} s", limit.as_secs()));
                said.push(format!("waiting for {} to start{limit}", name(supervised.instance)));
            }
        }
        said
    }

    fn note_incident(&mut self, i: usize, what: IncidentKind, detail: String) {
        self.incidents.push(Incident::of(self.roles[i].instance, what, detail));
    }

    /// Why the run ends, in one line: the role, what happened, its last message, and what to do. The log has its earlier
    /// messages.
    fn give_up_error(&self, name: &str, failures: u32, status: ExitStatus) -> anyhow::Error {
        let lines = self.log.last_lines(name);
        let message = match lines.last() {
            None if status.signal().is_some() => "it wrote no message; is memory short?",
            None => "it wrote no message",
            Some(last) => last.strip_prefix("error: ").unwrap_or(last),
        };
        anyhow!(
            "{name} failed {failures} times and is given up ({}): {message}; see shoal.log in the run's directory, fix \
             the cause, then `shoal resume {}` continues the run",
            describe_exit(status),
            self.run.display()
        )
    }
}

/// The kind of incident that the end of a process with this status is.
fn kind_of_end(status: ExitStatus) -> IncidentKind {
    match status.signal() {
        Some(_) => IncidentKind::Killed,
        None => IncidentKind::Failed,
    }
}
