//! Finds processes that should be working but make no progress. A process that waits for something that cannot happen
//! is killed and replaced, so that no fault, in shared memory or in this program, stalls a run for good.
//!
//! Slow processes are left alone: an environment server in a step, a stopped process, and processes that wait for them.

use std::time::{Duration, Instant};

use shoal_common::role::{Activity, Role};

use super::child::{Child, SILENT_AFTER};

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
    pub(super) fn find(&mut self, children: &mut [Child], busy: Duration) -> Vec<(usize, &'static str)> {
        let now = Instant::now();
        let since = now - std::mem::replace(&mut self.checked_at, now);
        if since.saturating_sub(busy) >= LAUNCHER_PAUSE {
            children.iter_mut().for_each(Child::reset_clocks);
            return Vec::new();
        }
        let mut found: Vec<_> = (0..children.len())
            .filter_map(|i| Some((i, self.reason_to_replace(children, i)?)))
            .filter(|(i, _)| !children[*i].is_stopped())
            .collect();
        if found.is_empty() && self.sees_whole_run {
            found = self.deadlock(children);
        }
        for (i, _) in &found {
            children[*i].stalls += 1;
            children[*i].reset_clocks();
        }
        found
    }

    /// Environment servers that have spent more than the timeout on one step or reset while their clients wait, and
    /// for how long. They are left alone.
    pub(super) fn slow_servers(&self, children: &[Child]) -> Vec<(usize, Duration)> {
        let is_waited_for = |index| {
            let mut clients = children.iter().filter(|client| client.server() == Some(index));
            clients.any(|client| client.is_responsive() && client.activity() == Some(Activity::WaitingForServer))
        };
        let servers = children.iter().enumerate().filter(|(_, child)| {
            child.instance.role == Role::EnvServer && child.is_active() && child.is_ready() && !child.is_stopped()
        });
        servers
            .map(|(i, server)| (i, server.silent_for()))
            .filter(|(i, silent)| *silent >= self.timeout && is_waited_for(children[*i].instance.index))
            .collect()
    }

    /// Why one child must be replaced, by its own state and that of its environment server or client.
    fn reason_to_replace(&self, children: &[Child], i: usize) -> Option<&'static str> {
        let child = &children[i];
        if !child.is_active() {
            return None;
        }
        if child.instance.role == Role::EnvServer {
            // Only if replacing its client has not helped.
            let client = children
                .iter()
                .find(|client| client.server() == Some(child.instance.index))?;
            let both = client.stalls > 0 && self.waits_for_an_idle_server(children, client);
            return both.then_some("it does not receive the request that its client waits on");
        }
        if self.waits_for_an_idle_server(children, child) && child.stalls == 0 {
            return Some("it waits for an answer from its environment server, which is idle");
        }
        let silent = child.silent_for() >= WORKING_FACTOR * self.timeout;
        let idle_server = child
            .server()
            .is_none_or(|index| find(children, Role::EnvServer, index).is_some_and(|server| self.is_idle(server)));
        (silent && idle_server && child.is_asleep()).then_some("it sends no heartbeats and all its threads sleep")
    }

    fn waits_for_an_idle_server(&self, children: &[Child], client: &Child) -> bool {
        let server = client.server().and_then(|index| find(children, Role::EnvServer, index));
        let waits = match client.activity() {
            // It becomes ready when its server has described its environments.
            None => client.is_active() && client.progress_at.elapsed() >= self.timeout,
            Some(activity) => activity == Activity::WaitingForServer && self.is_idle(client),
        };
        waits && server.is_some_and(|server| self.is_idle(server))
    }

    /// Whether it has waited without progress for too long.
    fn is_idle(&self, child: &Child) -> bool {
        child.is_active() && child.is_waiting() && child.progress_at.elapsed() >= self.timeout
    }

    /// The processes to replace if every process waits: first actors and evaluator; if that has not helped, the
    /// learner.
    fn deadlock(&self, children: &[Child]) -> Vec<(usize, &'static str)> {
        if !children.iter().all(|child| self.is_idle(child)) {
            return Vec::new();
        }
        let roles: &[Role] = if children.iter().any(|child| child.stalls > 0) {
            &[Role::Learner]
        } else {
            &[Role::Actor, Role::Evaluator]
        };
        let chosen = |i: &usize| roles.contains(&children[*i].instance.role);
        (0..children.len())
            .filter(chosen)
            .map(|i| (i, "every process of the run waits for another"))
            .collect()
    }
}

fn find(children: &[Child], role: Role, index: u32) -> Option<&Child> {
    children.iter().find(|child| child.is(role, index))
}
