//! All processes of a run: starts them, tracks which are ready, restarts them, and gives up those that cannot work.

mod admission;
mod faults;

use std::os::fd::AsFd;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use shoal_common::channel::control::{ControlPort, RoleStatus};
use shoal_common::channel::{Domain, Services};
use shoal_common::config::{Config, Mode};
use shoal_common::durable::write_atomically;
use shoal_common::report::Heartbeat;
use shoal_common::role::{Activity, Role, RoleInstance};
use shoal_common::run_dir::RunDir;
use shoal_run::child_process::{Writer, wait_for_any};
use shoal_run::records::recorder::{Incident, IncidentKind};
use shoal_run::signals::Signals;
use tracing_subscriber::filter::LevelFilter;

use self::faults::Faults;
use super::child::{Child, RestartDecision};
use super::cleaner;
use super::incarnations::{last_committed, read_counter};
use super::joined_hosts::{INCARNATIONS, JoinedHosts};
use super::log::{ALL_ENDED, Log};
use super::process::{Process, name};
use super::stall::StallDetector;
use crate::log_level::log_level;

/// How often to look for dead processes whose end the launcher does not observe, such as `shoal status`.
const CLEANUP_INTERVAL: Duration = Duration::from_secs(2);

/// How long dead processes may keep occupying shared memory in spite of clean-ups. A killed process may take a moment to
/// disappear.
const OCCUPIED_PATIENCE: Duration = Duration::from_secs(2);

/// How soon a clean-up is repeated while they do.
const OCCUPIED_CLEANUP_INTERVAL: Duration = Duration::from_millis(200);

/// A start that takes longer is reported to the user.
const SLOW_START: Duration = Duration::from_secs(10);

/// More incarnations than are used between two committed chunks, those of other hosts included. If the counter is lost,
/// this many are skipped.
const STARTS_WITHOUT_CHUNK: u64 = 64 * INCARNATIONS;

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

/// The host whose processes are supervised, and with it which processes there are.
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
    children: Vec<Child>,
    services: Services,
    /// Number of actors whose services have been created.
    actors_with_services: u32,
    window: u32,
    /// Since when dead processes have occupied shared memory in spite of clean-ups.
    occupied_since: Option<Instant>,
    /// Time spent on clean-ups since the last search for stalls.
    cleanup_time: Duration,
    /// The wanted actors of this host, in order.
    actors: Vec<u32>,
    /// The most actors that the run may have on all hosts.
    max_actors: u32,
    /// The number of actors of a lockstep run, on all hosts together. It never changes.
    lockstep_actors: Option<u32>,
    joined_hosts: JoinedHosts,
    log: Log,
    /// Incidents since the last [`Supervisor::take_incidents`].
    incidents: Vec<Incident>,
    run: PathBuf,
    /// Whether the output of environment servers is Shoal's own or another program's. With `SHOAL_LOG=debug` all of it
    /// is logged.
    server_output: Writer,
    /// How long an environment's own program may take to start.
    server_start_limit: Option<Duration>,
    /// The file with the number of processes ever started. It lasts over resumes: incarnations are never used twice.
    counter: PathBuf,
    processes_started: u64,
    faults: Faults,
    /// A role is given up if its failures span this time.
    give_up_after: Duration,
    all_ready: bool,
    cleaned_at: Instant,
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
        let counter = run.incarnations();
        let mut started = read_counter(&counter)?;
        let committed = last_committed(run)?;
        if started < committed {
            // The counter was lost. A reused incarnation would repeat noise, and its chunks would count as old ones.
            started = committed.saturating_add(STARTS_WITHOUT_CHUNK);
            log.note(
                "launcher",
                &format!("{} is missing or wrong; counting from {started}", counter.display()),
            );
        }
        let mut services = Services::new(domain)?;
        services.create_common(domain)?;
        let server = config.evaluation_server();
        let lockstep = config.run.mode == Mode::Lockstep;
        let mut lockstep_actors = None;
        let (children, actors) = match host {
            SupervisedHost::OfLearner { gate } => {
                services.create_environment(domain, server)?;
                let mut children = vec![
                    Child::new(Role::Learner, 0),
                    Child::new(Role::EnvServer, server),
                    Child::new(Role::Evaluator, 0).with_server(server),
                ];
                children.extend(gate.then(|| Child::new(Role::Gate, 0)));
                lockstep_actors = lockstep.then_some(config.actors.count);
                (children, (0..config.actors.count).collect())
            }
            SupervisedHost::Joined { actors } => (vec![Child::new(Role::Relay, 0)], actors),
        };
        Ok(Self {
            children,
            services,
            actors_with_services: 0,
            window: config.actors.window,
            occupied_since: None,
            cleanup_time: Duration::ZERO,
            actors,
            joined_hosts: JoinedHosts::new(started, Duration::from_secs_f64(config.remote.lost_seconds)),
            max_actors: config.actors.max,
            lockstep_actors,
            log,
            incidents: Vec::new(),
            run: run.path().into(),
            server_output: match log_level() {
                LevelFilter::DEBUG | LevelFilter::TRACE => Writer::Shoal,
                _ if config.environment.server.is_empty() => Writer::Shoal,
                _ => Writer::Program,
            },
            server_start_limit: (!config.environment.server.is_empty()).then(|| config.environment.start_limit()),
            counter,
            processes_started: started,
            faults: Faults {
                count: 0,
                most: config.environment.faults,
                last: String::new(),
            },
            give_up_after: Duration::from_secs(config.run.give_up_seconds),
            all_ready: false,
            cleaned_at: Instant::now(),
            learner_done: false,
            unsaved_learner: None,
        })
    }

    /// Starts all processes.
    pub(super) fn start_all(&mut self, domain: &Domain) -> anyhow::Result<()> {
        self.create_wanted_services(domain)?;
        (0..self.children.len()).try_for_each(|i| self.start(i))?;
        self.start_missing(domain)
    }

    /// The incidents since the last call, in order.
    pub(super) fn take_incidents(&mut self) -> Vec<Incident> {
        std::mem::take(&mut self.incidents)
    }

    /// Changes the wanted number of actors. [`maintain`](Self::maintain) starts or retires them.
    pub(super) fn scale(&mut self, actors: u32) {
        let before = self.actors.len();
        self.log
            .note("launcher", &format!("scaled from {before} to {actors} actors"));
        let detail = format!("{before} to {actors} actors");
        self.incidents.push(Incident::of_launcher(IncidentKind::Scaled, detail));
        self.actors.truncate(actors as usize);
        let missing = actors as usize - self.actors.len();
        let more: Vec<u32> = self.free_actors().take(missing).collect();
        self.actors.extend(more);
        self.actors.sort_unstable();
    }

    /// The wanted number of actors on this host.
    pub(super) fn actor_count(&self) -> u32 {
        self.actors.len() as u32
    }

    /// The most actors that this host may have now.
    pub(super) fn max_actors_now(&self) -> u32 {
        self.actor_count() + self.free_actors().count() as u32
    }

    /// Indices that neither this host nor another has.
    fn free_actors(&self) -> impl Iterator<Item = u32> {
        (0..self.max_actors).filter(|index| !self.actors.contains(index) && !self.joined_hosts.has(*index))
    }

    /// Kills an actor of this incarnation or an earlier one, so that it is started again.
    pub(super) fn replace_actor(&mut self, index: u32, incarnation: u64) {
        let actor = self.children.iter_mut().find(|child| child.is(Role::Actor, index));
        if let Some(actor) = actor.filter(|actor| actor.instance.incarnation <= incarnation)
            && let Some(process) = &mut actor.process
        {
            process.kill();
        }
    }

    /// Creates the services of all actors below `end`.
    fn create_services(&mut self, domain: &Domain, end: u32) -> anyhow::Result<()> {
        while self.actors_with_services < end {
            self.services
                .create_actor(domain, self.actors_with_services, self.window)?;
            self.actors_with_services += 1;
        }
        Ok(())
    }

    /// Creates the services of all wanted actors.
    fn create_wanted_services(&mut self, domain: &Domain) -> anyhow::Result<()> {
        let end = self.actors.iter().max().map_or(0, |last| last + 1);
        self.create_services(domain, end)
    }

    fn write_counter(&self) -> anyhow::Result<()> {
        let text = self.processes_started.to_string();
        write_atomically(&self.counter, |file| std::io::Write::write_all(file, text.as_bytes()))
            .with_context(|| format!("cannot write {}", self.counter.display()))
    }

    /// Adds and starts the wanted actors that do not exist, each with its environment server.
    fn start_missing(&mut self, domain: &Domain) -> anyhow::Result<()> {
        self.create_wanted_services(domain)?;
        for index in self.actors.clone() {
            for role in [Role::EnvServer, Role::Actor] {
                if !self.children.iter().any(|child| child.is(role, index)) {
                    self.children.push(Child::new(role, index));
                    self.start(self.children.len() - 1)?;
                }
            }
        }
        Ok(())
    }

    fn start(&mut self, i: usize) -> anyhow::Result<()> {
        self.processes_started += 1;
        self.write_counter()?;
        let child = &mut self.children[i];
        child.instance.incarnation = self.processes_started;
        let writer = match child.instance.role {
            Role::EnvServer => self.server_output,
            _ => Writer::Shoal,
        };
        let process = Process::start(child.instance, &self.run, &self.log, writer)?;
        self.log
            .note(&name(child.instance), &format!("started as process {}", process.pid()));
        child.begin(process);
        Ok(())
    }

    /// Starts the gate again if it has just died and other hosts are waiting for news.
    ///
    /// # Errors
    /// When it cannot be started.
    pub(super) fn ensure_gate(&mut self) -> anyhow::Result<()> {
        if self.joined_hosts.leases().is_empty() {
            return Ok(());
        }
        self.reap(|role| role == Role::Gate);
        let is_missing = |child: &Child| child.instance.role == Role::Gate && child.process.is_none();
        match self.children.iter().position(is_missing) {
            Some(i) => self.start(i),
            None => Ok(()),
        }
    }

    /// Records a heartbeat.
    pub(super) fn record(&mut self, heartbeat: &Heartbeat) {
        let child = self.children.iter_mut().find(|child| {
            let RoleInstance {
                role,
                index,
                incarnation,
            } = child.instance;
            (heartbeat.role(), heartbeat.index, heartbeat.incarnation) == (Some(role), index, incarnation)
        });
        let Some(child) = child else { return };
        let faults = heartbeat.faults.saturating_sub(child.faults());
        let (client, server) = (name(child.instance), child.server());
        if let Some(after) = child.record(heartbeat) {
            self.log
                .note(&name(child.instance), &format!("ready after {} ms", after.as_millis()));
        }
        if let Some(index) = server {
            // A heartbeat may claim any number.
            (0..faults.min(self.faults.most)).for_each(|_| self.note_fault(&client, index));
        }
        if !self.all_ready && self.children.iter().all(Child::is_ready) {
            self.all_ready = true;
            self.log.note("launcher", "every role is ready");
        }
    }

    /// The activity of a role: that of its first process with a heartbeat.
    pub(super) fn activity(&self, role: Role) -> Option<Activity> {
        let mut of_role = self.children.iter().filter(|child| child.instance.role == role);
        of_role.find_map(Child::activity)
    }

    /// Whether there is a learner that is ready.
    pub(super) fn has_learner(&self) -> bool {
        let learner = self.learner();
        learner.is_some_and(|learner| learner.process.is_some() && learner.is_ready())
    }

    /// Total number of restarts.
    pub(super) fn restarts(&self) -> u32 {
        self.children.iter().map(|child| child.restarts).sum()
    }

    /// The status of all processes. `newest` is the version of the learner's newest policy.
    pub(super) fn status(&self, newest: u64) -> Vec<RoleStatus> {
        let mut children: Vec<_> = self.children.iter().collect();
        children.sort_by_key(|child| (std::cmp::Reverse(child.instance.role), child.instance.index));
        children.into_iter().map(|child| child.status(newest)).collect()
    }

    /// Sleeps at most `most`, until a process ends, a signal arrives or a request comes. Returns whether one of them
    /// has happened.
    pub(super) fn sleep(&mut self, signals: &Signals, control: &ControlPort, most: Duration) -> bool {
        let exits = self
            .children
            .iter()
            .filter_map(|child| child.process.as_ref()?.exit_descriptor());
        let wakers: Vec<_> = exits.chain([signals.as_fd(), control.as_fd()]).collect();
        let woken = wait_for_any(&wakers, most);
        // So that the same events do not wake it again.
        signals.received();
        self.collect_exits();
        woken
    }

    /// The time until the next restart or clean-up, unless a process ends earlier.
    pub(super) fn time_to_next_task(&self) -> Duration {
        let since_clean = self.cleaned_at.elapsed();
        let cleaning = self.cleanup_interval().saturating_sub(since_clean);
        let missing = |child: &&Child| child.process.is_none() && self.is_wanted(child);
        let now = Instant::now();
        let restarts = self.children.iter().filter(missing);
        restarts
            .map(|child| child.restart_at.saturating_duration_since(now))
            .fold(cleaning, Duration::min)
    }

    /// Collects the exit statuses of ended processes. Their last reports are read before [`maintain`](Self::maintain)
    /// handles the ends.
    fn collect_exits(&mut self) {
        for child in self.children.iter_mut().filter(|child| child.ended.is_none()) {
            child.ended = child.process.as_mut().and_then(Process::exit_status);
        }
    }

    /// Handles collected ends, restarts processes that are due, and starts or retires actors.
    pub(super) fn maintain(&mut self, domain: &Domain) -> anyhow::Result<RunCondition> {
        let mut condition = RunCondition::AtWork;
        let ended = self.children.iter().any(|child| child.ended.is_some());
        // Before anything is cleaned up or started: both would find the files of another run, or none.
        if (ended || self.is_cleanup_due()) && !self.learner_has_finished() && !domain.is_intact(self.services.count())
        {
            return Ok(RunCondition::FilesRemoved);
        }
        if ended {
            // Frees their shared memory for their successors.
            condition = self.clean(domain)?;
        } else if self.is_cleanup_due() {
            self.cleaned_at = Instant::now();
            if domain.has_dead_nodes() || self.services.ports_of_dead_processes() > 0 {
                condition = self.clean(domain)?;
            }
        }
        for i in 0..self.children.len() {
            if self.maintain_one(i)? == RunCondition::LearnerDone {
                return Ok(RunCondition::LearnerDone);
            }
        }
        self.retire_surplus();
        self.start_missing(domain)?;
        Ok(condition)
    }

    fn is_cleanup_due(&self) -> bool {
        self.cleaned_at.elapsed() >= self.cleanup_interval()
    }

    fn cleanup_interval(&self) -> Duration {
        self.occupied_since
            .map_or(CLEANUP_INTERVAL, |_| OCCUPIED_CLEANUP_INTERVAL)
    }

    fn learner(&self) -> Option<&Child> {
        self.children.iter().find(|child| child.instance.role == Role::Learner)
    }

    /// Whether the learner's end has been observed, and it was the planned one.
    fn learner_has_finished(&self) -> bool {
        let ended = self.learner().and_then(|learner| learner.ended);
        ended.is_some_and(|status| status.success())
    }

    fn maintain_one(&mut self, i: usize) -> anyhow::Result<RunCondition> {
        if let Some(status) = self.children[i].ended.take()
            && self.handle_end(i, status)? == RunCondition::LearnerDone
        {
            return Ok(RunCondition::LearnerDone);
        }
        let is_wanted = self.is_wanted(&self.children[i]);
        let child = &mut self.children[i];
        if child.process.is_none() && is_wanted && Instant::now() >= child.restart_at {
            // One that has retired and is wanted again did not fail.
            child.restarts += u32::from(!child.is_retiring);
            self.start(i)?;
            self.note_incident(i, IncidentKind::StartedAgain, String::new());
        }
        Ok(RunCondition::AtWork)
    }

    fn handle_end(&mut self, i: usize, status: ExitStatus) -> anyhow::Result<RunCondition> {
        let child = &mut self.children[i];
        let name = name(child.instance);
        self.log.write_left_out(&name);
        if child.instance.role == Role::Learner && status.success() {
            child.process = None;
            self.learner_done = true;
            self.log.note(&name, "done");
            return Ok(RunCondition::LearnerDone);
        }
        if child.is_retiring {
            child.process = None;
            child.restart_at = Instant::now();
            self.log.note(&name, &format!("retired: {}", ending(status)));
            self.note_incident(i, IncidentKind::Retired, String::new());
            return Ok(RunCondition::AtWork);
        }
        let decision = child.handle_end(status, self.give_up_after);
        let what = if status.signal().is_some() {
            IncidentKind::Killed
        } else {
            IncidentKind::Failed
        };
        self.note_incident(i, what, ending(status));
        match decision {
            RestartDecision::Restart(pause) => {
                self.children[i].restart_at = Instant::now() + pause;
                self.log
                    .note(&name, &format!("{}; restarting it in {pause:?}", ending(status)));
                Ok(RunCondition::AtWork)
            }
            RestartDecision::GiveUp(starts) => {
                self.note_incident(i, IncidentKind::GivenUp, String::new());
                self.give_up(&name, starts, status)
            }
        }
    }

    /// Kills stalled processes, so that they are replaced. Returns a message for each.
    pub(super) fn replace_stalled(&mut self, stalls: &mut StallDetector) -> Vec<String> {
        let stalled = stalls.find(&mut self.children, std::mem::take(&mut self.cleanup_time));
        let mut messages = Vec::new();
        for (i, why) in stalled {
            let child = &mut self.children[i];
            messages.push(format!(
                "{} makes no progress: {why}; it is replaced",
                name(child.instance)
            ));
            if let Some(process) = &mut child.process {
                process.kill();
            }
            self.note_incident(i, IncidentKind::Stalled, why.into());
        }
        messages
    }

    /// Messages about slow processes, one for each: environment servers in one step or reset, and roles that are
    /// starting. An environment's program that is not ready in time is ended, which counts as a failure.
    pub(super) fn report_slow(&mut self, stalls: &StallDetector) -> Vec<String> {
        let mut said = Vec::new();
        for (i, silent) in stalls.slow_servers(&self.children) {
            let child = &mut self.children[i];
            if child.mark_reported_slow() {
                let (name, seconds) = (name(child.instance), silent.as_secs());
                said.push(format!(
                    "{name} has spent {seconds} s in one step or reset of its environments; it is not interrupted"
                ));
            }
        }
        for child in &mut self.children {
            let Some(starting) = child.starting_for() else { continue };
            let limit = self
                .server_start_limit
                .filter(|_| child.instance.role == Role::EnvServer);
            if limit.is_some_and(|limit| starting >= limit) {
                let text = "is not ready within environment.start_seconds and is ended";
                self.log.note(&name(child.instance), text);
                child.kill_slow_start();
            } else if starting >= SLOW_START && child.mark_reported_slow() {
                let limit = limit.map_or(String::new(), |limit| format!(", for at most {} s", limit.as_secs()));
                said.push(format!("waiting for {} to start{limit}", name(child.instance)));
            }
        }
        said
    }

    fn note_incident(&mut self, i: usize, what: IncidentKind, detail: String) {
        self.incidents
            .push(Incident::of(self.children[i].instance, what, detail));
    }

    /// Frees shared memory that dead processes occupy.
    fn clean(&mut self, domain: &Domain) -> anyhow::Result<RunCondition> {
        let begun = Instant::now();
        let cleaned = cleaner::clean_up(domain, &self.services);
        self.cleaned_at = Instant::now();
        self.cleanup_time += begun.elapsed();
        if let Err(error) = &cleaned {
            self.log.note("launcher", &format!("{error:#}"));
        }
        if self.services.ports_of_dead_processes() == 0 {
            self.occupied_since = None;
            return Ok(RunCondition::AtWork);
        }
        let since = *self.occupied_since.get_or_insert(begun);
        if cleaned.is_ok() && since.elapsed() >= OCCUPIED_PATIENCE {
            return Ok(RunCondition::SharedMemoryOccupied);
        }
        Ok(RunCondition::AtWork)
    }

    /// Retires surplus actors and then their environment servers.
    fn retire_surplus(&mut self) {
        let has_no_client = |children: &[Child], child: &Child| {
            child.instance.role == Role::EnvServer
                && !children.iter().any(|actor| actor.is(Role::Actor, child.instance.index))
        };
        let mut children = std::mem::take(&mut self.children);
        children.retain(|child| {
            let stays = child.process.is_some() || self.is_wanted(child);
            if !stays {
                self.log.note(&name(child.instance), "no longer needed");
            }
            stays
        });
        self.children = children;
        for i in 0..self.children.len() {
            if self.is_wanted(&self.children[i]) || self.children[i].is_retiring {
                continue;
            }
            let may_end =
                self.children[i].instance.role == Role::Actor || has_no_client(&self.children, &self.children[i]);
            let child = &mut self.children[i];
            if let Some(process) = child.process.as_mut().filter(|_| may_end) {
                child.is_retiring = true;
                process.ask_to_retire();
            }
        }
    }

    /// Whether the child should run: not a surplus actor, and not the environment server of one.
    fn is_wanted(&self, child: &Child) -> bool {
        let RoleInstance { role, index, .. } = child.instance;
        // The index of the evaluator's server is the maximum number of actors.
        !matches!(role, Role::Actor | Role::EnvServer) || index >= self.max_actors || self.actors.contains(&index)
    }

    /// One line: what happened to whom, its last message, and what to do. The log has its earlier messages.
    fn give_up(&self, name: &str, starts: u32, status: ExitStatus) -> anyhow::Result<RunCondition> {
        let lines = self.log.last_lines(name);
        let message = match lines.last() {
            None if status.signal().is_some() => "it wrote no message; is memory short?",
            None => "it wrote no message",
            Some(last) => last.strip_prefix("error: ").unwrap_or(last),
        };
        bail!(
            "{name} failed {starts} times and is given up ({}): {message}; see shoal.log in the run's directory, fix \
             the cause, then `shoal resume {}` continues the run",
            ending(status),
            self.run.display()
        );
    }

    /// Asks the processes of a role to hand over what they have and then to end.
    pub(super) fn ask_to_retire(&mut self, role: Role) {
        for child in self.children.iter_mut().filter(|child| child.instance.role == role) {
            if let Some(process) = &mut child.process {
                child.is_asked_to_end = true;
                process.ask_to_retire();
            }
        }
    }

    /// Asks the processes of some roles to end.
    pub(super) fn ask_to_end(&mut self, which: impl Fn(Role) -> bool) {
        for child in self.children.iter_mut().filter(|child| which(child.instance.role)) {
            match &mut child.process {
                Some(process) => {
                    child.is_asked_to_end = true;
                    process.ask_to_end();
                }
                None if child.instance.role == Role::Learner && !self.learner_done => {
                    self.unsaved_learner = Some("it had died and was not restarted yet".into());
                }
                None => {}
            }
        }
    }

    /// Collects the exit statuses of some roles' processes. Returns whether all of them have ended.
    pub(super) fn reap(&mut self, which: impl Fn(Role) -> bool) -> bool {
        let mut all = true;
        for child in self.children.iter_mut().filter(|child| which(child.instance.role)) {
            let Some(process) = &mut child.process else { continue };
            match process.exit_status() {
                Some(status) => {
                    child.process = None;
                    if child.instance.role == Role::Learner && !status.success() {
                        self.unsaved_learner = Some(ending(status));
                    }
                }
                None => all = false,
            }
        }
        all
    }

    /// Kills the processes of some roles that did not end when they were asked to.
    pub(super) fn kill(&mut self, which: impl Fn(Role) -> bool) {
        for child in self.children.iter_mut().filter(|child| which(child.instance.role)) {
            if child.process.take().is_some() {
                let name = name(child.instance);
                self.log.note(&name, "did not end when asked to, and was killed");
                let detail = "did not end when asked to".into();
                self.incidents
                    .push(Incident::of(child.instance, IncidentKind::Killed, detail));
                if child.instance.role == Role::Learner {
                    self.unsaved_learner = Some("it did not end when asked to, and was killed".into());
                }
            }
        }
    }

    /// Logs that every role has ended.
    ///
    /// # Errors
    /// When the learner did not save its state before it ended.
    pub(super) fn check_saved(&self) -> anyhow::Result<()> {
        self.log.note("launcher", ALL_ENDED);
        let Some(how) = &self.unsaved_learner else {
            return Ok(());
        };
        let learner = self.learner().map(|learner| name(learner.instance));
        let lines = learner.map_or_else(Vec::new, |learner| self.log.last_lines(&learner));
        let message = lines.last().map_or_else(String::new, |line| format!(": {line}"));
        bail!(
            "the learner did not save its last state ({how}){message}; `shoal resume {}` continues from the newest \
             checkpoint",
            self.run.display()
        );
    }
}

fn ending(status: ExitStatus) -> String {
    match (status.signal(), status.code()) {
        (Some(signal), _) => format!("killed by signal {signal}"),
        (_, Some(code)) => format!("ended with exit code {code}"),
        _ => "ended".into(),
    }
}
