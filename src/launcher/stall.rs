//! Who should be working and is not. A process that waits for something that cannot come any more is ended, and replaced as
//! one that has died: no fault of shared memory, and none of ours, leaves a run standing still.
//!
//! What is slow is left alone: an environment server over a step, a stopped process, and whoever waits for one of these.

use std::time::{Duration, Instant};

use shoal_common::report::{Activity, Role};

use super::child::{Child, SILENT};

/// A launcher that was away for so long was stopped, and the others perhaps too: nobody is accused then.
const AWAY: Duration = Duration::from_secs(2);

/// How many times as long a process that waits for nobody may say nothing: it may be at work.
const WORK: u32 = 3;

/// Looks for processes that do not get on.
#[derive(Debug)]
pub(super) struct Stalls {
    patience: Duration,
    looked: Instant,
}

impl Stalls {
    /// Nobody may stand still for longer than `patience`.
    pub(super) fn new(patience: Duration) -> Self {
        Self {
            patience: patience.max(SILENT),
            looked: Instant::now(),
        }
    }

    /// Who is to be replaced, and why. Since this was asked last the launcher was `busy` for so long.
    pub(super) fn find(&mut self, children: &mut [Child], busy: Duration) -> Vec<(usize, &'static str)> {
        let now = Instant::now();
        let since = now - std::mem::replace(&mut self.looked, now);
        if since.saturating_sub(busy) >= AWAY {
            children.iter_mut().for_each(Child::excuse);
            return Vec::new();
        }
        let mut found: Vec<_> = (0..children.len())
            .filter_map(|i| Some((i, self.accuse(children, i)?)))
            .filter(|(i, _)| !children[*i].is_stopped())
            .collect();
        if found.is_empty() {
            found = self.deadlock(children);
        }
        for (i, _) in &found {
            children[*i].stalls += 1;
            children[*i].excuse();
        }
        found
    }

    /// Environment servers that have been over one step or reset for longer than the patience while their clients wait, and for
    /// how long. They are left alone.
    pub(super) fn slow_servers(&self, children: &[Child]) -> Vec<(usize, Duration)> {
        let is_waited_for = |index| {
            let mut clients = children.iter().filter(|client| client.server() == Some(index));
            clients.any(|client| client.is_heard() && client.activity() == Some(Activity::WaitingForServer))
        };
        let servers = children.iter().enumerate().filter(|(_, child)| {
            child.identity.role == Role::EnvServer && child.is_present() && child.is_ready() && !child.is_stopped()
        });
        servers
            .map(|(i, server)| (i, server.silent_for()))
            .filter(|(i, silent)| *silent >= self.patience && is_waited_for(children[*i].identity.index))
            .collect()
    }

    /// What is wrong with one child, whatever the others but its environment server do.
    fn accuse(&self, children: &[Child], i: usize) -> Option<&'static str> {
        let child = &children[i];
        if !child.is_present() {
            return None;
        }
        if child.identity.role == Role::EnvServer {
            // Only where replacing its client has not helped.
            let client = children
                .iter()
                .find(|client| client.server() == Some(child.identity.index))?;
            let both = client.stalls > 0 && self.waits_for_an_idle_server(children, client);
            return both.then_some("it does not hear its client, which waits for its answer");
        }
        if self.waits_for_an_idle_server(children, child) && child.stalls == 0 {
            return Some("it waits for an answer of its environment server, which has nothing to do");
        }
        let silent = child.silent_for() >= WORK * self.patience;
        let idle_server = child
            .server()
            .is_none_or(|index| find(children, Role::EnvServer, index).is_some_and(|server| self.is_idle(server)));
        (silent && idle_server && child.sleeps()).then_some("nothing was heard of it, and it sleeps")
    }

    fn waits_for_an_idle_server(&self, children: &[Child], client: &Child) -> bool {
        let server = client.server().and_then(|index| find(children, Role::EnvServer, index));
        let waits = match client.activity() {
            // It is ready once its server has said what it serves.
            None => client.is_present() && client.moved.elapsed() >= self.patience,
            Some(activity) => activity == Activity::WaitingForServer && self.is_idle(client),
        };
        waits && server.is_some_and(|server| self.is_idle(server))
    }

    /// Whether it has waited, and not got on, for too long.
    fn is_idle(&self, child: &Child) -> bool {
        child.is_present() && child.waits() && child.moved.elapsed() >= self.patience
    }

    /// Everybody waits, and nobody works: the actors and the evaluator are replaced, or where that has not helped the learner.
    fn deadlock(&self, children: &[Child]) -> Vec<(usize, &'static str)> {
        if !children.iter().all(|child| self.is_idle(child)) {
            return Vec::new();
        }
        let roles: &[Role] = if children.iter().any(|child| child.stalls > 0) {
            &[Role::Learner]
        } else {
            &[Role::Actor, Role::Evaluator]
        };
        let chosen = |i: &usize| roles.contains(&children[*i].identity.role);
        (0..children.len())
            .filter(chosen)
            .map(|i| (i, "every process of the run waits for another"))
            .collect()
    }
}

fn find(children: &[Child], role: Role, index: u32) -> Option<&Child> {
    children.iter().find(|child| child.is(role, index))
}
