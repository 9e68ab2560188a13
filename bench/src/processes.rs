//! The processes of a run that is measured: a learner, actors, and their environment servers. There is no launcher: who
//! dies is not started again, and no evaluator.

use rustix::thread::CpuSet;
use shoal_common::report::{Identity, Role};
use shoal_common::run_dir::RunDir;
use shoal_run::process::Peer;

/// Who is there.
#[derive(Debug)]
pub(super) struct Processes(Vec<(Role, Peer)>);

impl Processes {
    /// Starts a learner and so many actors, each with its environment server; `chosen` says on which cores a role shall run.
    pub(super) fn start(run: &RunDir, actors: u32, chosen: impl Fn(Role) -> Option<CpuSet>) -> anyhow::Result<Self> {
        let pairs = (0..actors).flat_map(|index| [(Role::EnvServer, index), (Role::Actor, index)]);
        let mut processes = Self(Vec::new());
        for (incarnation, (role, index)) in (1..).zip([(Role::Learner, 0)].into_iter().chain(pairs)) {
            let identity = Identity {
                role,
                index,
                incarnation,
            };
            let peer = Peer::member(identity, run)?;
            if let Some(cores) = chosen(role) {
                peer.pin(&cores)?;
            }
            processes.0.push((role, peer));
        }
        Ok(processes)
    }

    /// An error if anyone has ended, with what it said last.
    pub(super) fn check(&mut self) -> anyhow::Result<()> {
        self.0.iter_mut().try_for_each(|(_, peer)| peer.check())
    }

    /// Does `act` while everyone but the learner is stopped.
    pub(super) fn with_actors_paused<T>(&self, act: impl FnOnce() -> T) -> anyhow::Result<T> {
        let explorers = || self.0.iter().filter(|(role, _)| *role != Role::Learner);
        let paused = explorers().try_for_each(|(_, peer)| peer.pause());
        let acted = paused.is_ok().then(act);
        // Whatever happened: one that is stopped would not end either.
        let mut woken = Ok(());
        for (_, peer) in explorers() {
            woken = woken.and(peer.go_on());
        }
        paused.and(woken)?;
        acted.ok_or_else(|| anyhow::anyhow!(super::measurement::INTERRUPTED))
    }

    /// Asks everyone to end, the actors first, so that the learner still takes what they send; and waits for them.
    pub(super) fn end(mut self) -> anyhow::Result<()> {
        let mut ended = Ok(());
        for now in [Role::Actor, Role::EnvServer, Role::Learner] {
            let (mut leaving, staying): (Vec<_>, Vec<_>) = self.0.into_iter().partition(|(role, _)| *role == now);
            leaving.iter_mut().for_each(|(_, peer)| peer.ask_to_end());
            for (_, peer) in leaving {
                ended = ended.and(peer.end());
            }
            self.0 = staying;
        }
        ended
    }
}
