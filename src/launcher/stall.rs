//! Who should be working and is not. A process that waits for something that cannot come any more is ended, and replaced as
//! one that has died: no fault of shared memory, and none of ours, leaves a run standing still.
//!
//! What is slow is left alone: an environment server over a step, a stopped process, and whoever waits for one of these.

use std::time::{Duration, Instant};

use shoal_common::report::{Activity, Role};

use super::member::{Member, SILENT};

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
    pub(super) fn find(&mut self, members: &mut [Member], busy: Duration) -> Vec<(usize, &'static str)> {
        let now = Instant::now();
        let since = now - std::mem::replace(&mut self.looked, now);
        if since.saturating_sub(busy) >= AWAY {
            members.iter_mut().for_each(Member::excuse);
            return Vec::new();
        }
        let mut found: Vec<_> = (0..members.len())
            .filter_map(|i| Some((i, self.accuse(members, i)?)))
            .filter(|(i, _)| !members[*i].is_stopped())
            .collect();
        if found.is_empty() {
            found = self.deadlock(members);
        }
        for (i, _) in &found {
            members[*i].stalls += 1;
            members[*i].excuse();
        }
        found
    }

    /// What is wrong with one member, whatever the others but its environment server do.
    fn accuse(&self, members: &[Member], i: usize) -> Option<&'static str> {
        let member = &members[i];
        if !member.is_present() {
            return None;
        }
        if member.identity.role == Role::EnvServer {
            // Only where replacing its client has not helped.
            let client = members
                .iter()
                .find(|client| client.server() == Some(member.identity.index))?;
            let both = client.stalls > 0 && self.waits_for_an_idle_server(members, client);
            return both.then_some("it does not hear its client, which waits for its answer");
        }
        if self.waits_for_an_idle_server(members, member) && member.stalls == 0 {
            return Some("it waits for an answer of its environment server, which has nothing to do");
        }
        let silent = member.silent_for() >= WORK * self.patience;
        let idle_server = member
            .server()
            .is_none_or(|index| find(members, Role::EnvServer, index).is_some_and(|server| self.is_idle(server)));
        (silent && idle_server && member.sleeps()).then_some("nothing was heard of it, and it sleeps")
    }

    fn waits_for_an_idle_server(&self, members: &[Member], client: &Member) -> bool {
        let server = client.server().and_then(|index| find(members, Role::EnvServer, index));
        let waits = match client.activity() {
            // It is ready once its server has said what it serves.
            None => client.is_present() && client.moved.elapsed() >= self.patience,
            Some(activity) => activity == Activity::WaitingForServer && self.is_idle(client),
        };
        waits && server.is_some_and(|server| self.is_idle(server))
    }

    /// Whether it has waited, and not got on, for too long.
    fn is_idle(&self, member: &Member) -> bool {
        member.is_present() && member.waits() && member.moved.elapsed() >= self.patience
    }

    /// Everybody waits, and nobody works: the actors and the evaluator are replaced, or where that has not helped the learner.
    fn deadlock(&self, members: &[Member]) -> Vec<(usize, &'static str)> {
        if !members.iter().all(|member| self.is_idle(member)) {
            return Vec::new();
        }
        let roles: &[Role] = if members.iter().any(|member| member.stalls > 0) {
            &[Role::Learner]
        } else {
            &[Role::Actor, Role::Evaluator]
        };
        let chosen = |i: &usize| roles.contains(&members[*i].identity.role);
        (0..members.len())
            .filter(chosen)
            .map(|i| (i, "every process of the run waits for another"))
            .collect()
    }
}

fn find(members: &[Member], role: Role, index: u32) -> Option<&Member> {
    members.iter().find(|member| member.is(role, index))
}
