//! The hosts that have joined a run: which actors and incarnations each has.

use std::time::{Duration, Instant};

use shoal_common::channel::control::{HostLease, HostState, HostStatus};

use super::shares::ActorHost;

/// The hosts that have joined.
#[derive(Debug)]
pub(super) struct JoinedHosts {
    epoch: u64,
    /// A host that is silent for this long loses its actors, so that another host may have them.
    lost_after: Duration,
    admitted: Vec<Admitted>,
}

#[derive(Debug)]
struct Admitted {
    lease: HostLease,
    heard_at: Instant,
    status: Option<HostStatus>,
}

impl JoinedHosts {
    /// No hosts. `epoch` is greater for each start of the launcher; a host that is silent for `lost_after` loses its
    /// actors.
    pub(super) fn new(epoch: u64, lost_after: Duration) -> Self {
        Self {
            epoch,
            lost_after,
            admitted: Vec::new(),
        }
    }

    pub(super) fn epoch(&self) -> u64 {
        self.epoch
    }

    /// What each host has.
    pub(super) fn leases(&self) -> Vec<HostLease> {
        self.admitted.iter().map(|admitted| admitted.lease.clone()).collect()
    }

    pub(super) fn lease(&self, host: u64) -> Option<&HostLease> {
        let mut leases = self.admitted.iter().map(|admitted| &admitted.lease);
        leases.find(|lease| lease.host == host)
    }

    /// The last status of each host.
    pub(super) fn statuses(&self) -> Vec<HostStatus> {
        self.admitted
            .iter()
            .filter_map(|admitted| admitted.status.clone())
            .collect()
    }

    /// Each host with its name, cores and wanted actors, in the order in which they were admitted.
    pub(super) fn actor_hosts(&self) -> impl Iterator<Item = ActorHost> {
        self.admitted.iter().map(|admitted| ActorHost {
            name: Some(admitted.lease.name.clone()),
            cores: admitted.lease.cores,
            actors: admitted.lease.wanted_actors,
        })
    }

    /// Changes the wanted actors of all hosts, in the order of [`actor_hosts`](Self::actor_hosts).
    pub(super) fn set_wanted_actors(&mut self, actors: &[u32]) {
        for (admitted, wanted) in self.admitted.iter_mut().zip(actors) {
            admitted.lease.wanted_actors = *wanted;
        }
    }

    /// The number of free actors that are kept for joined hosts which are about to have more actors than they have.
    pub(super) fn reserved(&self) -> usize {
        let more = |lease: &HostLease| (lease.wanted_actors as usize).saturating_sub(lease.actors.len());
        self.admitted.iter().map(|admitted| more(&admitted.lease)).sum()
    }

    /// Whether a host has this actor.
    pub(super) fn has(&self, actor: u32) -> bool {
        self.admitted
            .iter()
            .any(|admitted| admitted.lease.actors.contains(&actor))
    }

    /// Admits a host, or replaces the lease of an admitted one.
    pub(super) fn admit(&mut self, lease: HostLease) {
        self.admitted.retain(|admitted| admitted.lease.host != lease.host);
        self.admitted.push(Admitted {
            lease,
            heard_at: Instant::now(),
            status: None,
        });
    }

    /// Updates the status of each host. Returns a message for each that has left or is given up.
    pub(super) fn update(&mut self, statuses: Vec<HostStatus>) -> Vec<String> {
        for status in statuses {
            if let Some(admitted) = self
                .admitted
                .iter_mut()
                .find(|admitted| admitted.lease.host == status.host)
            {
                if status.state == HostState::Connected {
                    admitted.heard_at = Instant::now();
                }
                admitted.status = Some(status);
            }
        }
        let mut messages = Vec::new();
        self.admitted.retain(|admitted| {
            let left = admitted
                .status
                .as_ref()
                .is_some_and(|status| status.state == HostState::Left);
            let name = &admitted.lease.name;
            if left {
                messages.push(format!("host {name} has left"));
            } else if admitted.heard_at.elapsed() >= self.lost_after {
                messages.push(format!(
                    "host {name} was silent for {} s: its actors are free",
                    self.lost_after.as_secs()
                ));
            } else {
                return true;
            }
            false
        });
        messages
    }
}
