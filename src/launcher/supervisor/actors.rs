//! The actors of this host: which are wanted, and their services, start and retirement.

use std::collections::BTreeSet;
use std::time::{Duration, Instant};

use shoal_common::channel::Domain;
use shoal_common::config::ActorsConfig;
use shoal_common::role::{Role, RoleInstance};
use shoal_common::run_dir::RunDir;
use shoal_remote::wire::cores;
use shoal_run::records::recorder::{Incident, IncidentKind};

use super::Supervisor;
use crate::launcher::local_actors;
use crate::launcher::process::name;
use crate::launcher::shares::ActorHost;
use crate::launcher::supervised_role::SupervisedRole;

/// The pause before the next attempt to create what further actors need.
const REFUSED_ACTORS_PAUSE: Duration = Duration::from_secs(1);

/// Since when the system has refused what wanted actors need, and when to try again.
#[derive(Clone, Copy, Debug)]
struct RefusedActors {
    since: Instant,
    retry_at: Instant,
}

/// The actors of this host, and how many there may be.
#[derive(Debug)]
pub(super) struct ActorSet {
    /// The wanted actors of this host, in order.
    pub(super) wanted: Vec<u32>,
    /// How many further actors this host gets as soon as other hosts have released them.
    pub(super) to_take: usize,
    /// Set while the system refuses what wanted actors need.
    refused: Option<RefusedActors>,
    /// The most actors that the run may have on all hosts.
    pub(super) max: u32,
    /// The most actors that this host may have. Their indices are below this number.
    pub(super) max_here: u32,
    /// The number of actors of a lockstep run, on all hosts together. It never changes.
    pub(super) lockstep_count: Option<u32>,
    /// Actors whose services for transitions exist, and those whose environment server has its services.
    with_services: BTreeSet<u32>,
    servers_with_services: BTreeSet<u32>,
}

impl ActorSet {
    pub(super) fn new(wanted: Vec<u32>, lockstep_count: Option<u32>, config: &ActorsConfig) -> Self {
        Self {
            wanted,
            to_take: 0,
            refused: None,
            max: config.max,
            max_here: config.max_on_a_host(),
            lockstep_count,
            with_services: BTreeSet::new(),
            servers_with_services: BTreeSet::new(),
        }
    }

    /// The wanted number of actors on this host.
    fn count(&self) -> u32 {
        (self.wanted.len() + self.to_take) as u32
    }

    /// Whether the role should run: not a surplus actor, and not the environment server of one.
    pub(super) fn is_wanted(&self, supervised: &SupervisedRole) -> bool {
        let RoleInstance { role, index, .. } = supervised.instance;
        // The index of the evaluator's server is the maximum number of actors.
        !matches!(role, Role::Actor | Role::EnvServer) || index >= self.max || self.wanted.contains(&index)
    }
}

impl Supervisor {
    /// Changes the wanted number of actors of each host, in the order of [`actor_hosts`](Self::actor_hosts).
    /// [`maintain`](Self::maintain) starts or retires those of this host; joined hosts are told by the gate.
    pub(crate) fn scale(&mut self, shares: &[u32]) {
        let before = self.actor_count();
        let [here, joined @ ..] = shares else { return };
        let what = if joined.is_empty() {
            format!("{before} to {here} actors")
        } else {
            format!("{before} to {here} actors here, joined hosts to {joined:?}")
        };
        self.log.note("launcher", &format!("scaled from {what}"));
        self.incidents.push(Incident::of_launcher(IncidentKind::Scaled, what));
        self.actors.wanted.truncate(*here as usize);
        self.actors.to_take = *here as usize - self.actors.wanted.len();
        self.joined_hosts.set_wanted_actors(joined);
        self.take_free_actors();
        self.store_actors();
    }

    /// Takes free actors until this host has as many as are wanted. Another host may have to give some up first.
    pub(super) fn take_free_actors(&mut self) {
        if self.actors.to_take > 0 {
            let free = self.free_actors().filter(|index| *index < self.actors.max_here);
            let more: Vec<u32> = free.take(self.actors.to_take).collect();
            if more.is_empty() {
                return;
            }
            self.actors.to_take -= more.len();
            self.actors.wanted.extend(more);
            self.actors.wanted.sort_unstable();
            self.store_actors();
        }
    }

    /// Stores which actors this host has, for the next launcher. In a lockstep run this follows from the joined hosts.
    fn store_actors(&self) {
        let run = RunDir::at(&self.run);
        // By now another run may be at this path.
        let is_there = || run.directory_id().is_ok_and(|directory| directory == self.directory);
        if self.is_learner_host
            && self.actors.lockstep_count.is_none()
            && is_there()
            && let Err(error) = local_actors::write(&run, &self.actors.wanted)
        {
            // The run goes on. The only effect is that the next launcher may give the hosts other actors.
            self.log.note("launcher", &format!("{error:#}"));
        }
    }

    /// This host, and the joined ones.
    pub(crate) fn actor_hosts(&self) -> Vec<ActorHost> {
        let here = ActorHost {
            name: None,
            cores: cores(),
            actors: self.actor_count(),
        };
        std::iter::once(here).chain(self.joined_hosts.actor_hosts()).collect()
    }

    /// The wanted number of actors on this host.
    pub(crate) fn actor_count(&self) -> u32 {
        self.actors.count()
    }

    /// Indices that neither this host nor another has.
    pub(super) fn free_actors(&self) -> impl Iterator<Item = u32> {
        (0..self.actors.max).filter(|index| !self.actors.wanted.contains(index) && !self.joined_hosts.has(*index))
    }

    /// Kills an actor of this incarnation or an earlier one, so that it is started again.
    pub(crate) fn replace_actor(&mut self, index: u32, incarnation: u64) {
        let actor = self.roles.iter_mut().find(|it| it.is(Role::Actor, index));
        if let Some(actor) = actor.filter(|actor| actor.instance.incarnation <= incarnation)
            && let Some(process) = &mut actor.process
        {
            process.kill();
        }
    }

    /// Creates the services for the transitions of these actors.
    pub(super) fn create_transitions(
        &mut self,
        domain: &Domain,
        actors: impl IntoIterator<Item = u32>,
    ) -> anyhow::Result<()> {
        for actor in actors {
            if !self.actors.with_services.contains(&actor) {
                self.services.create_transitions(domain, actor, self.window)?;
                self.actors.with_services.insert(actor);
            }
        }
        Ok(())
    }

    /// Creates the services of all wanted actors and their environment servers.
    pub(super) fn create_wanted_services(&mut self, domain: &Domain) -> anyhow::Result<()> {
        for actor in &self.actors.wanted {
            if !self.actors.servers_with_services.contains(actor) {
                self.services.create_environment(domain, *actor)?;
                self.actors.servers_with_services.insert(*actor);
            }
        }
        match self.actors.wanted.iter().max().copied() {
            // The learner opens those of all actors up to the last one.
            Some(last) if self.is_learner_host => self.create_transitions(domain, 0..=last),
            _ => self.create_transitions(domain, self.actors.wanted.clone()),
        }
    }

    /// Adds and starts the wanted actors that do not exist, each with its environment server. If the system refuses what
    /// they need, as it does while too many files are open, it is tried again later.
    ///
    /// # Errors
    /// When the system has refused for too long.
    pub(super) fn start_missing(&mut self, domain: &Domain) -> anyhow::Result<()> {
        let now = Instant::now();
        if self.actors.refused.is_some_and(|refused| now < refused.retry_at) {
            return Ok(());
        }
        let missing = self.missing();
        let prepared = self
            .create_wanted_services(domain)
            .and_then(|()| self.incarnations.reserve(missing.len() as u64));
        if let Err(error) = prepared {
            let since = self.actors.refused.map_or(now, |refused| refused.since);
            if now.duration_since(since) >= self.give_up_after {
                return Err(error.context("further actors cannot be started"));
            }
            let pause = REFUSED_ACTORS_PAUSE;
            self.log.note(
                "launcher",
                &format!("further actors: {error:#}; trying again in {pause:?}"),
            );
            let retry_at = now + pause;
            self.actors.refused = Some(RefusedActors { since, retry_at });
            return Ok(());
        }
        self.actors.refused = None;
        for (role, index) in missing {
            self.roles.push(SupervisedRole::new(role, index));
            self.start(self.roles.len() - 1)?;
        }
        Ok(())
    }

    /// The wanted actors and environment servers that do not exist, each server before its actor.
    pub(super) fn missing(&self) -> Vec<(Role, u32)> {
        let wanted = self.actors.wanted.iter();
        let mut missing: Vec<_> = wanted
            .flat_map(|index| [(Role::EnvServer, *index), (Role::Actor, *index)])
            .collect();
        missing.retain(|(role, index)| !self.roles.iter().any(|it| it.is(*role, *index)));
        missing
    }

    /// Retires surplus actors and then their environment servers.
    pub(super) fn retire_surplus(&mut self) {
        let has_no_client = |roles: &[SupervisedRole], supervised: &SupervisedRole| {
            supervised.instance.role == Role::EnvServer
                && !roles
                    .iter()
                    .any(|actor| actor.is(Role::Actor, supervised.instance.index))
        };
        let mut roles = std::mem::take(&mut self.roles);
        roles.retain(|supervised| {
            let stays = supervised.process.is_some() || self.actors.is_wanted(supervised);
            if !stays {
                self.log.note(&name(supervised.instance), "no longer needed");
            }
            stays
        });
        self.roles = roles;
        for i in 0..self.roles.len() {
            if self.actors.is_wanted(&self.roles[i]) || self.roles[i].is_retiring {
                continue;
            }
            let may_end = self.roles[i].instance.role == Role::Actor || has_no_client(&self.roles, &self.roles[i]);
            let supervised = &mut self.roles[i];
            if let Some(process) = supervised.process.as_mut().filter(|_| may_end) {
                supervised.is_retiring = true;
                process.ask_to_retire();
            }
        }
    }
}
