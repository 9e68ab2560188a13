//! The processes of a measured run: a learner, actors and their environment servers. There is no evaluator, and no
//! launcher that would replace a process that dies.

use rustix::thread::CpuSet;
use shoal_common::role::{Role, RoleInstance};
use shoal_common::run_dir::RunDir;
use shoal_run::child_process::ChildProcess;

/// The running processes.
#[derive(Debug)]
pub(super) struct Processes(Vec<(Role, ChildProcess)>);

impl Processes {
    /// Starts a learner, and `actors` actors each with its environment server. `cores_for` returns the cores to bind a
    /// role to.
    pub(super) fn start(run: &RunDir, actors: u32, cores_for: impl Fn(Role) -> Option<CpuSet>) -> anyhow::Result<Self> {
        let pairs = (0..actors).flat_map(|index| [(Role::EnvServer, index), (Role::Actor, index)]);
        let mut processes = Self(Vec::new());
        for (incarnation, (role, index)) in (1..).zip([(Role::Learner, 0)].into_iter().chain(pairs)) {
            let instance = RoleInstance {
                role,
                index,
                incarnation,
            };
            let process = ChildProcess::of_instance(instance, run)?;
            if let Some(cores) = cores_for(role) {
                process.pin(&cores)?;
            }
            processes.0.push((role, process));
        }
        Ok(processes)
    }

    /// Returns an error, with the last output of the process, if one of them has ended.
    pub(super) fn check(&mut self) -> anyhow::Result<()> {
        self.0.iter_mut().try_for_each(|(_, process)| process.check())
    }

    /// Calls `act` while all processes except the learner are stopped.
    pub(super) fn with_actors_paused<T>(&self, act: impl FnOnce() -> T) -> anyhow::Result<T> {
        let all_but_the_learner = || self.0.iter().filter(|(role, _)| *role != Role::Learner);
        let paused = all_but_the_learner().try_for_each(|(_, process)| process.pause());
        let acted = paused.map(|()| act());
        // Even after an error, because a stopped process would not end.
        let mut resumed = Ok(());
        for (_, process) in all_but_the_learner() {
            resumed = resumed.and(process.resume());
        }
        let acted = acted?;
        resumed?;
        Ok(acted)
    }

    /// Asks all processes to end and waits for them. The actors end first, so that the learner still receives what they
    /// send.
    pub(super) fn end(mut self) -> anyhow::Result<()> {
        let mut ended = Ok(());
        for now in [Role::Actor, Role::EnvServer, Role::Learner] {
            let (mut leaving, staying): (Vec<_>, Vec<_>) = self.0.into_iter().partition(|(role, _)| *role == now);
            leaving.iter_mut().for_each(|(_, process)| process.ask_to_end());
            for (_, process) in leaving {
                ended = ended.and(process.end());
            }
            self.0 = staying;
        }
        ended
    }
}
