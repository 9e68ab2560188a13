//! The run that a measurement is about: the preset `pendulum` in a temporary directory that goes with it.

use anyhow::Context;
use rustix::thread::CpuSet;
use shoal_common::channel::{Domain, Services};
use shoal_common::commit::ReplayLayout;
use shoal_common::config::{Config, DdpgConfig};
use shoal_common::report::Role;
use shoal_common::run_dir::RunDir;
use shoal_run::plan::Plan;
use shoal_run::plan::RunOverrides;
use shoal_run::preflight;
use shoal_run::process::Peer;
use tempfile::TempDir;

use super::processes::Processes;

/// A run that exists until this is dropped.
#[derive(Debug)]
pub(super) struct Scene {
    pub(super) config: Config,
    pub(super) run: RunDir,
    directory: TempDir,
}

/// DDPG's numbers: the only learner that is measured.
pub(super) fn ddpg(config: &Config) -> anyhow::Result<&DdpgConfig> {
    config.algorithm.ddpg().context("only DDPG is measured")
}

impl Scene {
    /// The preset with one actor of one environment and these settings, as `--set` takes them.
    pub(super) fn new(set: &[&str]) -> anyhow::Result<Self> {
        Self::of(1, 1, set)
    }

    /// The preset with so many actors, so many environments of each, and these settings.
    pub(super) fn of(actors: u32, envs: u32, set: &[&str]) -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new()
            .prefix("shoal-bench-")
            .tempdir()
            .context("cannot make a temporary directory")?;
        let choices = RunOverrides {
            run: Some(directory.path().join("run")),
            seed: Some(1),
            actors: Some(actors),
            envs: Some(envs),
            set: set.iter().map(|assignment| (*assignment).into()).collect(),
            ..RunOverrides::default()
        };
        let Plan { config, run, .. } = Plan::new("pendulum", &choices)?;
        std::fs::create_dir(run.checkpoints()).context("cannot make the directory for checkpoints")?;
        Ok(Self { config, run, directory })
    }

    /// The replay that a learner of this run has when it is not in lockstep.
    pub(super) fn replay_layout(&self) -> ReplayLayout {
        ReplayLayout {
            row: self.config.row_layout(),
            ring: self.config.replay.capacity,
            actors: self.config.actors.max as usize,
            actor_snapshot_words: 0,
            fingerprint: self.config.fingerprint(),
        }
    }

    /// Removes the directory now; what is mapped of it stays mapped.
    pub(super) fn remove_directory(self) -> anyhow::Result<Config> {
        self.directory.close().context("cannot remove a temporary directory")?;
        Ok(self.config)
    }

    /// Does `act` while another process plays `role` 0 of the run; nothing of the run is left in shared memory after it.
    pub(super) fn with_peer<T>(
        &self,
        role: Role,
        act: impl FnOnce(&Domain, &mut Peer) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        self.in_shared_memory(|domain| {
            let mut peer = Peer::role(role, &self.run)?;
            let acted = act(domain, &mut peer);
            let ended = peer.end();
            let acted = acted?;
            ended?;
            Ok(acted)
        })
    }

    /// Does `act` while a learner, the run's actors and their environment servers are there; nothing of the run is left in
    /// shared memory after it. `chosen` says on which cores a role shall run.
    pub(super) fn with_crew<T>(
        &self,
        chosen: impl Fn(Role) -> Option<CpuSet>,
        act: impl FnOnce(&Domain, &mut Processes) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        self.in_shared_memory(|domain| {
            preflight::claim(&self.config, &self.run, domain)?;
            let mut processes = Processes::start(&self.run, self.config.actors.count, chosen)?;
            let acted = act(domain, &mut processes);
            let ended = processes.end();
            let acted = acted?;
            ended?;
            Ok(acted)
        })
    }

    /// The run's services, for as long as somebody uses them.
    fn services(&self, domain: &Domain) -> anyhow::Result<Services> {
        let mut services = Services::new(domain)?;
        services.create_common(domain)?;
        let actors = &self.config.actors;
        (0..actors.count).try_for_each(|index| services.create_actor(domain, index, actors.window))?;
        Ok(services)
    }

    /// Does `act` as a member of the run; nothing of the run is left in shared memory after it.
    pub(super) fn in_shared_memory<T>(&self, act: impl FnOnce(&Domain) -> anyhow::Result<T>) -> anyhow::Result<T> {
        Domain::remove_abandoned()?;
        let domain = Domain::join(&self.config.run.id, self.config.actors.max)?;
        let acted = self.services(&domain).and_then(|_services| act(&domain));
        let left = domain.leave();
        let acted = acted?;
        left?;
        Ok(acted)
    }
}

/// Settings of a run that is counted.
pub(super) fn counted_settings(actors: u32, updates: bool) -> Vec<&'static str> {
    let mut settings = vec![
        "run.steps=1_000_000_000_000",
        // A checkpoint has the disk brought up to date: another stage's work.
        "checkpoint.every_seconds=86_400",
        // What the model knows an update of.
        "learner.threads=1",
    ];
    if actors > 16 {
        settings.push("actors.max=256");
    }
    if updates {
        // Rows come faster than updates, so that one for each row is more than can be made; and no actor waits for them.
        settings.extend(["replay.updates_per_step=1", "replay.tolerance=1_000_000_000"]);
    } else {
        settings.push("replay.updates_per_step=0");
    }
    settings
}
