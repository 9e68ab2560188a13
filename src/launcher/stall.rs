//! Finds processes that should be working but make no progress. A process that waits for something that cannot happen
//! is killed and replaced, so that no fault, in shared memory or in this program, stalls a run for good.
//!
//! Slow processes are left alone: an environment server in a step, a stopped process, and processes that wait for them.

use std::time::{Duration, Instant};

use shoal_common::role::{Activity, Role};

use super::supervised_role::{SILENT_AFTER, SupervisedRole};

/// If the launcher itself did not run for this long, it was stopped, and perhaps the others too. No process is replaced
/// then.
const LAUNCHER_PAUSE: Duration = Duration::from_secs(2);

/// A process that may be at work is silent for too long only after this multiple of the timeout.
const WORKING_FACTOR: u32 = 3;

/// Looks for processes that make no progress.
#[derive(Debug)]
pub(super) struct StallDetector {
    timeout: Duration,
    /// Whether it sees all processes of the run, and not only those of a joined host.
    sees_whole_run: bool,
    checked_at: Instant,
}

impl StallDetector {
    /// `timeout` is the longest time without progress.
    pub(super) fn new(timeout: Duration) -> Self {
        Self {
            timeout: timeout.max(SILENT_AFTER),
            sees_whole_run: true,
            checked_at: Instant::now(),
        }
    }

    /// For the processes of a joined host. All of them may wait for the learner's host.
    pub(super) fn of_joined_host(timeout: Duration) -> Self {
        Self {
            sees_whole_run: false,
            ..Self::new(timeout)
        }
    }

    /// The processes to replace, with the reasons. `busy` is the time that the launcher has spent on clean-ups since
    /// the last call.
    pub(super) fn find(&mut self, roles: &mut [SupervisedRole], busy: Duration) -> Vec<(usize, &'static str)> {
        let now = Instant::now();
        let since = now - std::mem::replace(&mut self.checked_at, now);
        if since.saturating_sub(busy) >= LAUNCHER_PAUSE {
            roles.iter_mut().for_each(SupervisedRole::reset_clocks);
            return Vec::new();
        }
        let mut found: Vec<_> = (0..roles.len())
            .filter_map(|i| Some((i, self.reason_to_replace(roles, i)?)))
            .filter(|(i, _)| !roles[*i].is_stopped())
            .collect();
        if found.is_empty() && self.sees_whole_run {
            found = self.deadlock(roles);
        }
        for (i, _) in &found {
            roles[*i].stalls += 1;
            roles[*i].reset_clocks();
        }
        found
    }

    /// Environment servers that have spent more than the timeout on one step or reset while their clients wait, and
    /// for how long. They are left alone.
    pub(super) fn slow_servers(&self, roles: &[SupervisedRole]) -> Vec<(usize, Duration)> {
        let is_waited_for = |index| {
            let mut clients = roles.iter().filter(|client| client.server() == Some(index));
            clients.any(|client| client.is_responsive() && client.activity() == Some(Activity::WaitingForServer))
        };
        let servers = roles.iter().enumerate().filter(|(_, supervised)| {
            supervised.instance.role == Role::EnvServer
                && supervised.is_active()
                && supervised.is_ready()
                && !supervised.is_stopped()
        });
        servers
            .map(|(i, server)| (i, server.silent_for()))
            .filter(|(i, silent)| *silent >= self.timeout && is_waited_for(roles[*i].instance.index))
            .collect()
    }

    /// Why one role's process must be replaced, by its own state and that of its environment server or client.
    fn reason_to_replace(&self, roles: &[SupervisedRole], i: usize) -> Option<&'static str> {
        let supervised = &roles[i];
        if !supervised.is_active() {
            return None;
        }
        if supervised.instance.role == Role::EnvServer {
            // Only if replacing its client has not helped.
            let client = roles
                .iter()
                .find(|client| client.server() == Some(supervised.instance.index))?;
            let both = client.stalls > 0 && self.waits_for_an_idle_server(roles, client);
            return both.then_some("it does not receive the request that its client waits on");
        }
        if self.waits_for_an_idle_server(roles, supervised) && supervised.stalls == 0 {
            return Some("it waits for an answer from its environment server, which is idle");
        }
        let silent = supervised.silent_for() >= WORKING_FACTOR * self.timeout;
        let idle_server = supervised
            .server()
            .is_none_or(|index| find(roles, Role::EnvServer, index).is_some_and(|server| self.is_idle(server)));
        (silent && idle_server && supervised.is_asleep()).then_some("it sends no heartbeats and all its threads sleep")
    }

    fn waits_for_an_idle_server(&self, roles: &[SupervisedRole], client: &SupervisedRole) -> bool {
        let server = client.server().and_then(|index| find(roles, Role::EnvServer, index));
        let waits = match client.activity() {
            // It becomes ready when its server has described its environments.
            None => client.is_active() && client.progress_at.elapsed() >= self.timeout,
            Some(activity) => activity == Activity::WaitingForServer && self.is_idle(client),
        };
        waits && server.is_some_and(|server| self.is_idle(server))
    }

    /// Whether it has waited without progress for too long.
    fn is_idle(&self, supervised: &SupervisedRole) -> bool {
        supervised.is_active() && supervised.is_waiting() && supervised.progress_at.elapsed() >= self.timeout
    }

    /// The processes to replace if every process waits: first actors and evaluator; if that has not helped, the
    /// learner.
    fn deadlock(&self, roles: &[SupervisedRole]) -> Vec<(usize, &'static str)> {
        if !roles.iter().all(|it| self.is_idle(it)) {
            return Vec::new();
        }
        let replaced: &[Role] = if roles.iter().any(|it| it.stalls > 0) {
            &[Role::Learner]
        } else {
            &[Role::Actor, Role::Evaluator]
        };
        let chosen = |i: &usize| replaced.contains(&roles[*i].instance.role);
        (0..roles.len())
            .filter(chosen)
            .map(|i| (i, "every process of the run waits for another"))
            .collect()
    }
}

fn find(roles: &[SupervisedRole], role: Role, index: u32) -> Option<&SupervisedRole> {
    roles.iter().find(|it| it.is(role, index))
}
