//! All processes of a run: who is there, who is ready, who has to be started again, and who is given up.

use std::os::fd::BorrowedFd;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::ExitStatus;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use shoal_actor::explorer::GIVEN_UP;
use shoal_common::channel::control::RoleStatus;
use shoal_common::channel::environment::Fault;
use shoal_common::channel::{Domain, Services};
use shoal_common::config::Config;
use shoal_common::durable::write_atomically;
use shoal_common::report::{Activity, Heartbeat, Identity, Role};
use shoal_common::run_dir::RunDir;
use shoal_run::recorder::{Incident, What};

use super::child::{Child, Consequence};
use super::cleaner;
use super::incarnations::{last_committed, read_counter};
use super::log::{EVERYBODY_ENDED, Log};
use super::process::{Process, name};
use super::stall::Stalls;

/// How often the dead are cleaned up after whose end the launcher does not see: terminals that asked something.
const CLEANING: Duration = Duration::from_secs(2);

/// How long clean-ups may leave places occupied, and how soon the next one follows. A process may be dead and not yet gone.
const HOPELESS: Duration = Duration::from_secs(2);
const SOON: Duration = Duration::from_millis(200);

/// A start that takes longer is reported to the user.
const SLOW_START: Duration = Duration::from_secs(10);

/// More processes than are started without any of them sending a chunk.
const NEVER_SENT: u64 = 100_000;

/// How the processes of the run are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Situation {
    AtWork,
    LearnerDone,
    /// Dead processes have places in shared memory that cannot be freed.
    SharedMemoryOccupied,
}

/// All processes of a run.
#[derive(Debug)]
pub(super) struct Supervisor {
    children: Vec<Child>,
    services: Services,
    /// Actors whose services there are.
    served: u32,
    window: u32,
    /// Since when clean-ups have left places occupied.
    occupied: Option<Instant>,
    /// How long it has cleaned up since stalls were looked for last.
    busy: Duration,
    /// Actors there are to be, and may ever be.
    actors: u32,
    max_actors: u32,
    log: Log,
    /// What has happened since the last [`Supervisor::take_incidents`].
    incidents: Vec<Incident>,
    run: PathBuf,
    /// Where the number of processes ever started is kept: incarnations are never used twice, not by a resumed run either.
    counter: PathBuf,
    started: u64,
    /// Invalid answers of environments since the launcher started, and the last one.
    faults: u32,
    last_fault: String,
    all_ready: bool,
    cleaned: Instant,
    learner_done: bool,
    /// How the learner ended, if it was not with its state saved.
    unsaved: Option<String>,
}

impl Supervisor {
    pub(super) fn new(config: &Config, run: &RunDir, domain: &Domain, log: Log) -> anyhow::Result<Self> {
        let counter = run.incarnations();
        let mut started = read_counter(&counter)?;
        let committed = last_committed(run)?;
        if started < committed {
            // The counter was lost. A lower incarnation's chunks would be taken for old ones, and its noise was used.
            started = committed.saturating_add(NEVER_SENT);
            log.note(
                "launcher",
                &format!("{} is lost or wrong; counting on from {started}", counter.display()),
            );
        }
        let mut services = Services::new(domain)?;
        services.create_common(domain)?;
        services.create_environment(domain, config.evaluation_server())?;
        let server = config.evaluation_server();
        let children = vec![
            Child::new(Role::Learner, 0),
            Child::new(Role::EnvServer, server),
            Child::new(Role::Evaluator, 0).with_server(server),
        ];
        Ok(Self {
            children,
            services,
            served: 0,
            window: config.actors.window,
            occupied: None,
            busy: Duration::ZERO,
            actors: config.actors.count,
            max_actors: config.actors.max,
            log,
            incidents: Vec::new(),
            run: run.path().into(),
            counter,
            started,
            faults: 0,
            last_fault: String::new(),
            all_ready: false,
            cleaned: Instant::now(),
            learner_done: false,
            unsaved: None,
        })
    }

    /// Starts everyone.
    pub(super) fn start_all(&mut self, domain: &Domain) -> anyhow::Result<()> {
        self.serve(domain)?;
        (0..self.children.len()).try_for_each(|i| self.start(i))?;
        self.start_missing(domain)
    }

    /// What has happened since this was asked last, in order.
    pub(super) fn take_incidents(&mut self) -> Vec<Incident> {
        std::mem::take(&mut self.incidents)
    }

    /// Goes on with so many actors, who are started when this looks after everyone next.
    pub(super) fn scale(&mut self, actors: u32) {
        self.log.note(
            "launcher",
            &format!("actors: {actors} from now on, {} before", self.actors),
        );
        let detail = format!("{} to {actors} actors", self.actors);
        self.incidents.push(Incident::of_launcher(What::Scaled, detail));
        self.actors = actors;
    }

    /// Actors there are to be.
    pub(super) fn actors(&self) -> u32 {
        self.actors
    }

    /// Makes the services of actors that have come.
    fn serve(&mut self, domain: &Domain) -> anyhow::Result<()> {
        while self.served < self.actors {
            self.services.create_actor(domain, self.served, self.window)?;
            self.served += 1;
        }
        Ok(())
    }

    /// Makes and fills the places that are missing, each actor's with its environment server's.
    fn start_missing(&mut self, domain: &Domain) -> anyhow::Result<()> {
        self.serve(domain)?;
        for index in 0..self.actors {
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
        self.started += 1;
        let text = self.started.to_string();
        write_atomically(&self.counter, |file| std::io::Write::write_all(file, text.as_bytes()))
            .with_context(|| format!("cannot write {}", self.counter.display()))?;
        let child = &mut self.children[i];
        child.identity.incarnation = self.started;
        let process = Process::start(child.identity, &self.run, &self.log)?;
        self.log
            .note(&name(child.identity), &format!("started as process {}", process.pid()));
        child.begin(process);
        Ok(())
    }

    /// Takes note of a sign of life.
    pub(super) fn hear(&mut self, heartbeat: &Heartbeat) {
        let child = self.children.iter_mut().find(|child| {
            let Identity {
                role,
                index,
                incarnation,
            } = child.identity;
            (heartbeat.role(), heartbeat.index, heartbeat.incarnation) == (Some(role), index, incarnation)
        });
        let Some(child) = child else { return };
        let faults = heartbeat.faults.saturating_sub(child.faults());
        let (client, server) = (name(child.identity), child.server());
        if let Some(after) = child.hear(heartbeat) {
            self.log
                .note(&name(child.identity), &format!("ready after {} ms", after.as_millis()));
        }
        if let Some(index) = server {
            (0..faults).for_each(|_| self.note_fault(&client, index));
        }
        if !self.all_ready && self.children.iter().all(Child::is_ready) {
            self.all_ready = true;
            self.log.note("launcher", "every role is ready");
        }
    }

    fn note_fault(&mut self, client: &str, index: u32) {
        self.faults = self.faults.saturating_add(1);
        let server = self.children.iter().find(|child| child.is(Role::EnvServer, index));
        if let Some(server) = server {
            // The server has written what it was, unless it is one that does not check itself: then its client has.
            let by_client = self.log.last_lines(client).pop().filter(|line| line.contains(GIVEN_UP));
            let last = by_client.filter(|line| !line.contains(&Fault::Reported.to_string()));
            let last = last
                .or_else(|| self.log.last_lines(&name(server.identity)).pop())
                .unwrap_or_default();
            let last = last.strip_prefix("error: ").unwrap_or(&last);
            self.last_fault = format!("{}: {last}", name(server.identity));
            self.incidents
                .push(Incident::of(server.identity, What::Fault, last.into()));
        }
    }

    /// Whether environments may still return something invalid, or have done so too often.
    ///
    /// # Errors
    /// When they have: with what the last one was.
    pub(super) fn check_faults(&self, most: u32) -> anyhow::Result<()> {
        if self.faults < most {
            return Ok(());
        }
        bail!(
            "the environments returned something invalid {} times, and environment.faults is {most}; the last time: {}",
            self.faults,
            self.last_fault
        );
    }

    /// What the children of a role are doing: what the first one says that was heard of.
    pub(super) fn activity(&self, role: Role) -> Option<Activity> {
        let mut of_role = self.children.iter().filter(|child| child.identity.role == role);
        of_role.find_map(Child::activity)
    }

    /// Whether there is a learner, past its start.
    pub(super) fn has_learner(&self) -> bool {
        let mut learners = self
            .children
            .iter()
            .filter(|child| child.identity.role == Role::Learner);
        learners.any(|learner| learner.process.is_some() && learner.is_ready())
    }

    /// How often processes were started again.
    pub(super) fn restarts(&self) -> u32 {
        self.children.iter().map(|child| child.restarts).sum()
    }

    /// How everyone gets on, where the learner's newest policy is `newest`.
    pub(super) fn status(&self, newest: u64) -> Vec<RoleStatus> {
        let mut children: Vec<_> = self.children.iter().collect();
        children.sort_by_key(|child| (std::cmp::Reverse(child.identity.role), child.identity.index));
        children.into_iter().map(|child| child.status(newest)).collect()
    }

    /// What wakes the launcher when a process ends.
    pub(super) fn ends(&self) -> impl Iterator<Item = BorrowedFd<'_>> {
        self.children
            .iter()
            .filter_map(|child| child.process.as_ref().and_then(Process::end))
    }

    /// How long nothing is to be done for the children unless a process ends.
    pub(super) fn idle_for(&self) -> Duration {
        let since_clean = self.cleaned.elapsed();
        let cleaning = self.occupied.map_or(CLEANING, |_| SOON).saturating_sub(since_clean);
        let missing = |child: &&Child| child.process.is_none() && self.is_wanted(child);
        let now = Instant::now();
        let restarts = self.children.iter().filter(missing);
        restarts
            .map(|child| child.restart_at.saturating_duration_since(now))
            .fold(cleaning, Duration::min)
    }

    /// Sees whose processes have ended. What those said before is heard before [`look_after`](Self::look_after) acts on it.
    pub(super) fn see_ends(&mut self) {
        for child in self.children.iter_mut().filter(|child| child.ended.is_none()) {
            child.ended = child.process.as_mut().and_then(Process::exit_status);
        }
    }

    /// Acts on the ends that were seen, and starts processes again when their time has come.
    pub(super) fn look_after(&mut self, domain: &Domain) -> anyhow::Result<Situation> {
        let mut state = Situation::AtWork;
        if self.children.iter().any(|child| child.ended.is_some()) {
            // Their places in shared memory are free for their successors.
            state = self.clean(domain)?;
        } else if self.cleaned.elapsed() >= self.occupied.map_or(CLEANING, |_| SOON) {
            self.cleaned = Instant::now();
            if domain.has_dead_nodes() || self.services.occupied_by_the_dead() > 0 {
                state = self.clean(domain)?;
            }
        }
        for i in 0..self.children.len() {
            if self.look_after_one(i)? == Situation::LearnerDone {
                return Ok(Situation::LearnerDone);
            }
        }
        self.retire_surplus();
        self.start_missing(domain)?;
        Ok(state)
    }

    fn look_after_one(&mut self, i: usize) -> anyhow::Result<Situation> {
        if let Some(status) = self.children[i].ended.take()
            && self.act_on_end(i, status)? == Situation::LearnerDone
        {
            return Ok(Situation::LearnerDone);
        }
        let is_wanted = self.is_wanted(&self.children[i]);
        let child = &mut self.children[i];
        if child.process.is_none() && is_wanted && Instant::now() >= child.restart_at {
            child.restarts += 1;
            self.start(i)?;
            self.note_incident(i, What::StartedAgain, String::new());
        }
        Ok(Situation::AtWork)
    }

    fn act_on_end(&mut self, i: usize, status: ExitStatus) -> anyhow::Result<Situation> {
        let child = &mut self.children[i];
        let name = name(child.identity);
        if child.identity.role == Role::Learner && status.success() {
            child.process = None;
            self.learner_done = true;
            self.log.note(&name, "done");
            return Ok(Situation::LearnerDone);
        }
        if child.retires {
            child.process = None;
            child.restart_at = Instant::now();
            self.log.note(&name, &format!("retired: {}", ending(status)));
            self.note_incident(i, What::Retired, String::new());
            return Ok(Situation::AtWork);
        }
        let consequence = child.has_ended(status);
        let what = if status.signal().is_some() {
            What::Killed
        } else {
            What::Failed
        };
        self.note_incident(i, what, ending(status));
        match consequence {
            Consequence::Restart(pause) => {
                self.children[i].restart_at = Instant::now() + pause;
                self.log
                    .note(&name, &format!("{}; starting it again in {pause:?}", ending(status)));
                Ok(Situation::AtWork)
            }
            Consequence::GiveUp(starts) => {
                self.note_incident(i, What::GivenUp, String::new());
                self.give_up(&name, starts, status)
            }
        }
    }

    /// Ends processes that should be working and do not, so that they are replaced; what is to be said of each.
    pub(super) fn replace_stalled(&mut self, stalls: &mut Stalls) -> Vec<String> {
        let stalled = stalls.find(&mut self.children, std::mem::take(&mut self.busy));
        let mut said = Vec::new();
        for (i, why) in stalled {
            let child = &mut self.children[i];
            said.push(format!(
                "{} makes no progress: {why}; it is replaced",
                name(child.identity)
            ));
            if let Some(process) = &mut child.process {
                process.kill();
            }
            self.note_incident(i, What::Stalled, why.into());
        }
        said
    }

    /// What is to be said of processes that are slow, each once: environment servers over one step or reset, and roles that
    /// are starting. An environment's program that is not ready within `start_limit` is ended, which counts as a failure.
    pub(super) fn report_slow(&mut self, stalls: &Stalls, start_limit: Option<Duration>) -> Vec<String> {
        let mut said = Vec::new();
        for (i, silent) in stalls.slow_servers(&self.children) {
            let child = &mut self.children[i];
            if child.report_slow() {
                let (name, seconds) = (name(child.identity), silent.as_secs());
                said.push(format!(
                    "{name} has been over one step or reset of its environments for {seconds} s; it is left alone"
                ));
            }
        }
        for child in &mut self.children {
            let Some(starting) = child.starting_for() else { continue };
            let limit = start_limit.filter(|_| child.identity.role == Role::EnvServer);
            if limit.is_some_and(|limit| starting >= limit) {
                let text = "is not ready within environment.start_seconds and is ended";
                self.log.note(&name(child.identity), text);
                child.end_slow_start();
            } else if starting >= SLOW_START && child.report_slow() {
                let limit = limit.map_or(String::new(), |limit| format!(", for at most {} s", limit.as_secs()));
                said.push(format!("waiting for {} to start{limit}", name(child.identity)));
            }
        }
        said
    }

    fn note_incident(&mut self, i: usize, what: What, detail: String) {
        self.incidents
            .push(Incident::of(self.children[i].identity, what, detail));
    }

    /// Frees what dead processes have in shared memory.
    fn clean(&mut self, domain: &Domain) -> anyhow::Result<Situation> {
        let begun = Instant::now();
        let cleaned = cleaner::clean_up(domain, &self.services);
        self.cleaned = Instant::now();
        self.busy += begun.elapsed();
        if let Err(error) = &cleaned {
            self.log.note("launcher", &format!("{error:#}"));
        }
        if self.services.occupied_by_the_dead() == 0 {
            self.occupied = None;
            return Ok(Situation::AtWork);
        }
        let since = *self.occupied.get_or_insert(begun);
        if cleaned.is_ok() && since.elapsed() >= HOPELESS {
            return Ok(Situation::SharedMemoryOccupied);
        }
        Ok(Situation::AtWork)
    }

    /// Lets actors retire that are too many, and when they are gone their environment servers.
    fn retire_surplus(&mut self) {
        let serves_nobody = |children: &[Child], child: &Child| {
            child.identity.role == Role::EnvServer
                && !children.iter().any(|actor| actor.is(Role::Actor, child.identity.index))
        };
        let mut children = std::mem::take(&mut self.children);
        children.retain(|child| {
            let stays = child.process.is_some() || self.is_wanted(child);
            if !stays {
                self.log.note(&name(child.identity), "not needed any more");
            }
            stays
        });
        self.children = children;
        for i in 0..self.children.len() {
            if self.is_wanted(&self.children[i]) || self.children[i].retires {
                continue;
            }
            let may_end =
                self.children[i].identity.role == Role::Actor || serves_nobody(&self.children, &self.children[i]);
            let child = &mut self.children[i];
            if let Some(process) = child.process.as_mut().filter(|_| may_end) {
                child.retires = true;
                process.ask_to_retire();
            }
        }
    }

    /// Whether it is not an actor, or an actor's environment server, of which there are enough.
    fn is_wanted(&self, child: &Child) -> bool {
        let Identity { role, index, .. } = child.identity;
        // The evaluator's server comes after those of all actors there may be.
        !matches!(role, Role::Actor | Role::EnvServer) || !(self.actors..self.max_actors).contains(&index)
    }

    fn give_up(&self, name: &str, starts: u32, status: ExitStatus) -> anyhow::Result<Situation> {
        let mut lines = self.log.last_lines(name);
        lines.dedup();
        let said = match lines.split_last() {
            None if status.signal().is_some() => "it said nothing: something kills it; does memory run out?".into(),
            None => "it said nothing".into(),
            Some((last, [])) => last.strip_prefix("error: ").unwrap_or(last).to_owned(),
            Some(_) => format!("it said last\n  {}", lines.join("\n  ")),
        };
        bail!(
            "{name} failed {starts} times and is given up ({}); when its reason is gone, `shoal resume {}` goes on; {said}",
            ending(status),
            self.run.display()
        );
    }

    /// Asks the processes of some roles to end.
    pub(super) fn ask_to_end(&mut self, which: impl Fn(Role) -> bool) {
        for child in self.children.iter_mut().filter(|child| which(child.identity.role)) {
            match &mut child.process {
                Some(process) => {
                    child.ends = true;
                    process.ask_to_end();
                }
                None if child.identity.role == Role::Learner && !self.learner_done => {
                    self.unsaved = Some("it had died and was not back yet".into());
                }
                None => {}
            }
        }
    }

    /// Whether the processes of some roles have ended.
    pub(super) fn have_ended(&mut self, which: impl Fn(Role) -> bool) -> bool {
        let mut all = true;
        for child in self.children.iter_mut().filter(|child| which(child.identity.role)) {
            let Some(process) = &mut child.process else { continue };
            match process.exit_status() {
                Some(status) => {
                    child.process = None;
                    if child.identity.role == Role::Learner && !status.success() {
                        self.unsaved = Some(ending(status));
                    }
                }
                None => all = false,
            }
        }
        all
    }

    /// Kills the processes of some roles that did not end when they were asked to.
    pub(super) fn kill(&mut self, which: impl Fn(Role) -> bool) {
        for child in self.children.iter_mut().filter(|child| which(child.identity.role)) {
            if child.process.take().is_some() {
                let name = name(child.identity);
                self.log.note(&name, "did not end when asked to, and was killed");
                let detail = "did not end when asked to".into();
                self.incidents.push(Incident::of(child.identity, What::Killed, detail));
                if child.identity.role == Role::Learner {
                    self.unsaved = Some("it did not end when asked to, and was killed".into());
                }
            }
        }
    }

    /// Says that every role has ended.
    ///
    /// # Errors
    /// When the learner did not save its state at its end.
    pub(super) fn check_saved(&self) -> anyhow::Result<()> {
        self.log.note("launcher", EVERYBODY_ENDED);
        let Some(how) = &self.unsaved else { return Ok(()) };
        let lines = self.log.last_lines(&name(Identity {
            role: Role::Learner,
            index: 0,
            incarnation: 0,
        }));
        let said = lines.last().map_or_else(String::new, |line| format!(": {line}"));
        bail!(
            "the learner did not save its last state ({how}){said}; `shoal resume {}` goes on from the newest checkpoint",
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
