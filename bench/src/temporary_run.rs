//! The run that is measured: a preset in a temporary directory, `pendulum` unless the algorithm cannot control it.

use anyhow::Context;
use rustix::thread::CpuSet;
use shoal_common::channel::{Domain, Services};
use shoal_common::commit::ReplayLayout;
use shoal_common::config::{AlgorithmConfig, Config, DdpgConfig};
use shoal_common::role::Role;
use shoal_common::run_dir::RunDir;
use shoal_env_server::environment::make;
use shoal_run::child_process::ChildProcess;
use shoal_run::plan::Plan;
use shoal_run::plan::RunOverrides;
use shoal_run::preflight;
use tempfile::TempDir;

use super::processes::Processes;

/// Environments and their presets: one with continuous actions, one with discrete actions.
const TASKS: [&str; 2] = ["pendulum", "cart-pole"];

/// A run whose directory is removed when this is dropped.
#[derive(Debug)]
pub(super) struct TemporaryRun {
    pub(super) config: Config,
    pub(super) run: RunDir,
    directory: TempDir,
}

/// The settings of DDPG, which every stage but `learner` and `policy` measures.
pub(super) fn ddpg(config: &Config) -> anyhow::Result<&DdpgConfig> {
    config.algorithm.ddpg().context("only DDPG is measured")
}

impl TemporaryRun {
    /// The preset with one actor, one environment, and the assignments `set` in the form of `--set`.
    pub(super) fn new(set: &[&str]) -> anyhow::Result<Self> {
        Self::of(1, 1, set)
    }

    /// A preset with this algorithm, by default the preset's own, with one actor and one environment: the first of
    /// [`TASKS`] that the algorithm can control.
    pub(super) fn with_algorithm(algorithm: Option<&str>) -> anyhow::Result<Self> {
        let named = AlgorithmConfig::all()
            .into_iter()
            .find(|known| Some(known.name()) == algorithm);
        let controls = |task: &&str| {
            named.as_ref().is_none_or(|algorithm| {
                make(task, &toml::Table::new()).is_ok_and(|made| algorithm.check_spaces(&made.spec()).is_ok())
            })
        };
        let preset = TASKS.into_iter().find(controls).unwrap_or(TASKS[0]);
        let overrides = RunOverrides {
            algorithm: algorithm.map(Into::into),
            actors: Some(1),
            envs: Some(1),
            ..RunOverrides::default()
        };
        Self::from_plan(preset, overrides)
    }

    /// The preset with `actors` actors, `envs` environments per actor, and the assignments `set` in the form of
    /// `--set`.
    pub(super) fn of(actors: u32, envs: u32, set: &[&str]) -> anyhow::Result<Self> {
        let overrides = RunOverrides {
            actors: Some(actors),
            envs: Some(envs),
            set: set.iter().map(|assignment| (*assignment).into()).collect(),
            ..RunOverrides::default()
        };
        Self::from_plan("pendulum", overrides)
    }

    fn from_plan(preset: &str, overrides: RunOverrides) -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new()
            .prefix("shoal-bench-")
            .tempdir()
            .context("cannot make a temporary directory")?;
        let overrides = RunOverrides {
            run: Some(directory.path().join("run")),
            seed: Some(1),
            ..overrides
        };
        let Plan { config, run, .. } = Plan::new(preset, &overrides)?;
        std::fs::create_dir(run.checkpoints()).context("cannot make the directory for checkpoints")?;
        let run = run.unlock();
        Ok(Self { config, run, directory })
    }

    /// The replay layout of a learner that is not in lockstep.
    pub(super) fn replay_layout(&self) -> ReplayLayout {
        ReplayLayout {
            row: self.config.row_layout(),
            ring: self.config.replay.capacity,
            actors: self.config.actors.max as usize,
            actor_snapshot_words: 0,
            fingerprint: self.config.fingerprint(),
        }
    }

    /// Removes the directory now. Files that are mapped stay mapped.
    pub(super) fn remove_directory(self) -> anyhow::Result<Config> {
        self.directory.close().context("cannot remove a temporary directory")?;
        Ok(self.config)
    }

    /// Calls `act` while another process runs as `role` 0 of the run. Leaves nothing of the run in shared memory.
    pub(super) fn with_role<T>(
        &self,
        role: Role,
        act: impl FnOnce(&Domain, &mut ChildProcess) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        self.in_shared_memory(|domain| {
            let mut process = ChildProcess::role(role, &self.run)?;
            let acted = act(domain, &mut process);
            let ended = process.end();
            let acted = acted?;
            ended?;
            Ok(acted)
        })
    }

    /// Calls `act` while a learner, the run's actors and their environment servers are running. Leaves nothing of the
    /// run in shared memory. `cores_for` returns the cores to bind a role to.
    pub(super) fn with_processes<T>(
        &self,
        cores_for: impl Fn(Role) -> Option<CpuSet>,
        act: impl FnOnce(&Domain, &mut Processes) -> anyhow::Result<T>,
    ) -> anyhow::Result<T> {
        self.in_shared_memory(|domain| {
            preflight::reserve(&self.config, &self.run, domain)?;
            let mut processes = Processes::start(&self.run, self.config.actors.count, cores_for)?;
            let acted = act(domain, &mut processes);
            let ended = processes.end();
            let acted = acted?;
            ended?;
            Ok(acted)
        })
    }

    /// Creates the run's services. They exist while this or a process of the run holds them.
    fn services(&self, domain: &Domain) -> anyhow::Result<Services> {
        let mut services = Services::new(domain)?;
        services.create_common(domain)?;
        let actors = &self.config.actors;
        (0..actors.count).try_for_each(|index| services.create_actor(domain, index, actors.window))?;
        Ok(services)
    }

    /// Calls `act` as a member of the run. Leaves nothing of the run in shared memory.
    pub(super) fn in_shared_memory<T>(&self, act: impl FnOnce(&Domain) -> anyhow::Result<T>) -> anyhow::Result<T> {
        Domain::remove_abandoned()?;
        let domain = Domain::join(&self.config.run.id, self.config.actors.max_on_a_host())?;
        let acted = self.services(&domain).and_then(|_services| act(&domain));
        let left = domain.leave();
        let acted = acted?;
        left?;
        Ok(acted)
    }
}

/// Assignments for a run that goes on until the measurement is over, and is not disturbed by writing checkpoints.
pub(super) const UNDISTURBED: [&str; 2] = ["run.steps=1_000_000_000_000", "checkpoint.every_seconds=86_400"];

/// Assignments for a run whose steps are counted.
pub(super) fn settings_for_counting(actors: u32, updates: bool) -> Vec<&'static str> {
    let mut settings = UNDISTURBED.to_vec();
    // The model's cost of a gradient step is measured on one thread.
    settings.push("learner.threads=1");
    if actors > 16 {
        settings.push("actors.max=256");
    }
    if updates {
        // One gradient step per row is more than the learner can make, and with this tolerance no actor waits for it.
        settings.extend(["replay.updates_per_step=1", "replay.tolerance=1_000_000_000"]);
    } else {
        settings.push("replay.updates_per_step=0");
    }
    settings
}
