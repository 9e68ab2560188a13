//! The run that a measurement is about: the preset `pendulum` in a temporary directory that goes with it.

use anyhow::Context;
use shoal_common::channel::Domain;
use shoal_common::commit::ReplayLayout;
use shoal_common::config::{Config, Ddpg};
use shoal_common::report::Role;
use shoal_common::run_dir::RunDir;
use tempfile::TempDir;

use crate::cli::TrainArgs;
use crate::peer::Peer;
use crate::plan::Plan;

/// A run that exists until this is dropped.
#[derive(Debug)]
pub(super) struct Scene {
    pub(super) config: Config,
    pub(super) run: RunDir,
    directory: TempDir,
}

/// DDPG's numbers: the only learner that is measured.
pub(super) fn ddpg(config: &Config) -> anyhow::Result<&Ddpg> {
    config.algorithm.ddpg().context("only DDPG is measured")
}

impl Scene {
    /// The preset with these settings, as `--set` takes them.
    pub(super) fn new(set: &[&str]) -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new()
            .prefix("shoal-bench-")
            .tempdir()
            .context("cannot make a temporary directory")?;
        let Plan { config, run, .. } = Plan::new(&TrainArgs {
            what: "pendulum".into(),
            run: Some(directory.path().join("run")),
            seed: Some(1),
            actors: Some(1),
            envs: Some(1),
            set: set.iter().map(|assignment| (*assignment).into()).collect(),
            ..TrainArgs::default()
        })?;
        std::fs::create_dir(run.checkpoints()).context("cannot make the directory for checkpoints")?;
        Ok(Self { config, run, directory })
    }

    /// The replay that a learner of this run has when it is not in lockstep.
    pub(super) fn replay_layout(&self) -> ReplayLayout {
        ReplayLayout {
            row: self.config.row_layout(),
            ring: self.config.replay.capacity,
            actors: self.config.actors.max as usize,
            standing_words: 0,
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
        Domain::remove_abandoned()?;
        let domain = Domain::join(&self.config.run.id, self.config.actors.max)?;
        let acted = Peer::role(role, &self.run).and_then(|mut peer| {
            let acted = act(&domain, &mut peer);
            let ended = peer.end();
            let acted = acted?;
            ended?;
            Ok(acted)
        });
        let left = domain.leave();
        let acted = acted?;
        left?;
        Ok(acted)
    }
}
