//! Admission of other hosts: each gets actors and incarnations of its own.

use std::collections::HashSet;

use shoal_common::channel::Domain;
use shoal_common::channel::control::{ControlResponse, HostLease, HostRequest, HostStatus};
use shoal_common::config::ActorsConfig;
use shoal_common::role::Role;

use super::Supervisor;

impl Supervisor {
    /// Gives actors and incarnations to another host. One that an earlier launcher has given actors gets them again, if
    /// they are still free.
    ///
    /// # Errors
    /// When services cannot be created, or the counter cannot be written.
    pub(crate) fn admit(&mut self, domain: &Domain, request: HostRequest) -> anyhow::Result<ControlResponse> {
        let HostRequest {
            host,
            name,
            actors: requested,
            cores,
            held,
        } = request;
        if let Some(lease) = self.joined_hosts.lease(host) {
            return Ok(ControlResponse::Admitted(lease.clone()));
        }
        if let Err(why) = ActorsConfig::check_on_a_host(requested) {
            return Ok(ControlResponse::Refused(why));
        }
        let free: Vec<u32> = match self.actors.lockstep_count {
            // Processes for these actors end here; those of the other host continue from the same snapshots.
            Some(_) => self.actors.wanted.iter().rev().copied().collect(),
            // The services of a retiring actor are in use.
            None => {
                let exists = |index: u32| self.roles.iter().any(|it| it.is(Role::Actor, index));
                let mut free: Vec<u32> = self.free_actors().filter(|index| !exists(*index)).collect();
                // Actors that this host cannot have come first.
                free.sort_by_key(|index| (*index < self.actors.max_here, *index));
                let kept = self.actors.to_take + self.joined_hosts.reserved();
                free.truncate(free.len().saturating_sub(kept));
                free
            }
        };
        let requested = requested as usize;
        let distinct: HashSet<u32> = held.iter().copied().collect();
        let can_keep = held.len() == requested && distinct.len() == requested;
        let mut actors = if can_keep && held.iter().all(|index| free.contains(index)) {
            held
        } else if free.len() >= requested {
            free[..requested].to_vec()
        } else {
            if let Some(all) = self.actors.lockstep_count {
                return Ok(ControlResponse::Refused(format!(
                    "this lockstep run has {all} actors, of which other hosts have {}",
                    all as usize - free.len()
                )));
            }
            return Ok(ControlResponse::Refused(format!(
                "the run may have {} actors on all hosts together (actors.max, fixed when it was created), of which {} \
                 are free",
                self.actors.max,
                free.len()
            )));
        };
        actors.sort_unstable();
        let first_incarnation = self.incarnations.take(HostLease::INCARNATIONS)?;
        // The learner opens those of all actors up to the last one that has a service of its own.
        let with_service = actors.iter().filter(|index| **index < self.actors.max_here);
        let end = with_service.max().map_or(0, |last| last + 1);
        self.create_transitions(domain, 0..end)?;
        self.log
            .note("launcher", &format!("host {name} is admitted with actors {actors:?}"));
        let lease = HostLease {
            host,
            name,
            epoch: self.joined_hosts.epoch(),
            wanted_actors: actors.len() as u32,
            actors,
            cores,
            first_incarnation,
            limit: first_incarnation + HostLease::INCARNATIONS,
        };
        self.joined_hosts.admit(lease.clone());
        self.share_lockstep_actors();
        Ok(ControlResponse::Admitted(lease))
    }

    /// Updates the status of the joined hosts. The answer tells which of them are admitted.
    pub(crate) fn update_joined_hosts(&mut self, statuses: Vec<HostStatus>) -> ControlResponse {
        for message in self.joined_hosts.update(statuses) {
            self.log.note("launcher", &message);
        }
        self.share_lockstep_actors();
        self.take_free_actors();
        ControlResponse::Leases {
            epoch: self.joined_hosts.epoch(),
            leases: self.joined_hosts.leases(),
        }
    }

    /// In a lockstep run this host has all actors that no other has.
    fn share_lockstep_actors(&mut self) {
        if let Some(count) = self.actors.lockstep_count {
            self.actors.wanted = (0..count).filter(|index| !self.joined_hosts.has(*index)).collect();
        }
    }

    /// The status of the joined hosts.
    pub(crate) fn joined_hosts(&self) -> Vec<HostStatus> {
        self.joined_hosts.statuses()
    }
}
