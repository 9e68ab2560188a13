//! What a new run begins with: the networks of another run, with its replay if that is asked for, or the rows of a
//! dataset.
//!
//! `origin.json` in the new run's directory is written last. If it is missing, the start of the run was interrupted.

use std::path::Path;

use anyhow::{Context, bail};
use serde::{Deserialize, Serialize};
use shoal_common::algorithms::TransitionUse;
use shoal_common::config::{Config, Difference, explanation};
use shoal_common::run_dir::{LockedRun, RunDir, RunDirError};
use shoal_common::section::Change;
use shoal_common::versioned_file::VersionedFile;
use shoal_learner::algorithms::algorithm::SavedState;
use shoal_learner::algorithms::registry;
use shoal_learner::process::checkpoint::{Checkpoint, Checkpoints, Counters};
use shoal_learner::process::replay_layout;
use shoal_learner::replay::Replay;

use crate::demonstrations::Demonstrations;
use crate::usage::UsageError;

/// What a run began with: `origin.json`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Origin {
    /// With the networks of another run.
    Run(RunOrigin),
    /// With the rows of a dataset.
    Dataset(DatasetOrigin),
}

/// The dataset that supplied the initial rows.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct DatasetOrigin {
    /// Its name.
    pub dataset: String,
    /// Its episodes.
    pub episodes: u64,
    /// Its rows.
    pub rows: u64,
}

/// The run that supplied the initial networks.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunOrigin {
    /// The directory of the other run.
    pub run: String,
    /// Environment steps that its networks had learned from.
    pub env_steps: u64,
    /// Updates that they had.
    pub updates: u64,
    /// SHA-256 of their weights, as `weights_sha256` of `train --json`.
    pub weights_sha256: String,
    /// The number of initial rows, copied from its replay.
    pub rows: u64,
}

impl VersionedFile for Origin {
    const FORMAT: u32 = 1;
}

impl Origin {
    /// What a run began with; `None` if it began with networks of its own.
    ///
    /// # Errors
    /// When the file cannot be read, or has another format.
    pub fn read(run: &RunDir) -> anyhow::Result<Option<Self>> {
        Ok(Self::load_if_any(&run.origin())?)
    }

    /// The number of initial rows.
    pub fn rows(&self) -> u64 {
        match self {
            Self::Run(origin) => origin.rows,
            Self::Dataset(origin) => origin.rows,
        }
    }

    /// In words: `begins with …`.
    pub fn in_words(&self) -> String {
        match self {
            Self::Run(RunOrigin { run, updates, rows, .. }) => {
                let rows = if *rows > 0 {
                    format!(" and with {rows} rows of its replay")
                } else {
                    String::new()
                };
                format!("begins with the networks of {run} after {updates} updates{rows}")
            }
            Self::Dataset(DatasetOrigin {
                dataset,
                episodes,
                rows,
            }) => format!("begins with {rows} rows of the dataset {dataset} ({episodes} episodes)"),
        }
    }
}

/// What a new run is to begin with.
#[derive(Debug)]
pub(crate) enum PendingOrigin {
    Run(Box<SourceRun>),
    Dataset(Demonstrations),
}

impl PendingOrigin {
    /// Checks that a run with this configuration can begin with it, and adds the number of initial rows to the run's
    /// steps.
    ///
    /// # Errors
    /// When networks or rows do not fit. The message says what differs.
    pub(crate) fn prepare(&self, config: &mut Config) -> anyhow::Result<()> {
        let rows = match self {
            Self::Run(source) => source.check(config)?,
            Self::Dataset(demonstrations) => Some(demonstrations.check(config)?),
        };
        let Some(rows) = rows else { return Ok(()) };
        config.run.steps = config.run.steps.saturating_add(rows);
        // Updates begin with the run's own steps. The other run has already made the updates for its rows.
        (config.replay.ratio_since, config.replay.updates_before) = (rows, 0);
        Ok(config.check()?)
    }

    /// Writes the first files of the new run in this directory. Its configuration has been [prepared](Self::prepare).
    ///
    /// # Errors
    /// When a file cannot be written.
    pub(crate) fn write(&self, run: &RunDir, config: &Config) -> anyhow::Result<Origin> {
        let checkpoints = run.checkpoints();
        std::fs::create_dir_all(&checkpoints).with_context(|| format!("cannot create {}", checkpoints.display()))?;
        let origin = match self {
            Self::Run(source) => Origin::Run(source.write(run, config)?),
            Self::Dataset(demonstrations) => Origin::Dataset(demonstrations.write(run, config)?),
        };
        origin.store(&run.origin())?;
        Ok(origin)
    }

    /// A warning, if one is needed, about the rows that a run of this configuration begins with.
    pub(crate) fn warning(&self, config: &Config) -> Option<String> {
        match self {
            Self::Run(source) => source.warning(config),
            Self::Dataset(demonstrations) => demonstrations.warning(config),
        }
    }
}

/// A run to begin with.
#[derive(Debug)]
pub(crate) struct SourceRun {
    run: RunDir,
    config: Config,
    checkpoint: Checkpoint,
    /// Its replay, with the lock that keeps its own learner away.
    replay: Option<(Replay, LockedRun)>,
}

impl SourceRun {
    /// Opens the run in this directory. It may be running, unless its replay is asked for.
    ///
    /// # Errors
    /// When it has learned nothing yet, or its files cannot be read.
    pub(crate) fn open(path: &Path, with_replay: bool) -> anyhow::Result<Self> {
        let run = RunDir::open(path)?;
        let config = run.config()?;
        let here = path.display();
        let lock = with_replay
            .then(|| run.lock())
            .transpose()
            .map_err(|error| match error {
                RunDirError::Busy(_) => anyhow::anyhow!(
                    "{here} is running, and its replay with it: end it first, with `shoal stop {here}`, or leave out \
                 --with-replay"
                ),
                other => other.into(),
            })?;
        let loaded = Checkpoints::new(&run.checkpoints(), config.fingerprint()).load_newest()?;
        let Some(loaded) = loaded else {
            bail!("{here} has no checkpoint, so it has no networks to begin with");
        };
        let replay = lock.map(|lock| -> anyhow::Result<_> {
            if !run.replay_file().exists() {
                bail!("{here} has no replay: leave out --with-replay");
            }
            Ok((Replay::open(&run.replay_file(), &replay_layout(&config))?, lock))
        });
        Ok(Self {
            replay: replay.transpose()?,
            checkpoint: loaded.checkpoint,
            run,
            config,
        })
    }

    /// Checks that it fits a run with this configuration. Returns how many rows that run takes along, if it takes the
    /// replay.
    fn check(&self, config: &Config) -> Result<Option<u64>, UsageError> {
        self.check_networks(config)?;
        let Some((replay, _)) = &self.replay else {
            return Ok(None);
        };
        self.check_rows(config)?;
        Ok(Some(self.rows(replay, config)))
    }

    fn rows(&self, replay: &Replay, config: &Config) -> u64 {
        let rows = replay.rows();
        (rows.end - rows.start).min(config.replay.capacity)
    }

    fn check_networks(&self, config: &Config) -> Result<(), UsageError> {
        let there = self.run.path().display();
        let (old, new) = (&self.config, config);
        let algorithms = [old, new].map(|config| config.algorithm.name());
        let refused = |what: String| Err(UsageError(format!("--from {there}: {what}")));
        if algorithms[0] != algorithms[1] {
            return refused(format!(
                "it has networks of {}, and this run learns with {}",
                algorithms[0], algorithms[1]
            ));
        }
        // Networks of one shape may have inputs or outputs of another meaning: normalised, or of dueling heads.
        let shapes = |config: &Config| (config.learned_shapes(), config.policy_layout().ok());
        if shapes(old) == shapes(new) {
            return Ok(());
        }
        for (what, [old, new]) in [
            ("observations", [&old.spec.observation, &new.spec.observation]),
            ("actions", [&old.spec.action, &new.spec.action]),
        ] {
            if (old.width(), old.size()) != (new.width(), new.size()) {
                return refused(format!("its networks are for other {what}, {old:?} instead of {new:?}"));
            }
        }
        let more = old
            .algorithm
            .settings()
            .inherited_setting()
            .or(new.algorithm.settings().inherited_setting());
        let more = more.map(|(key, _)| format!("{}.{key}", algorithms[0]));
        let of_shape = |it: &Difference| it.change == Change::Shape || Some(&it.key) == more.as_ref();
        let shapes = old.differences(new).into_iter().filter(of_shape);
        let differing: Vec<String> = shapes.map(|it| format!("{} = {}", it.key, it.before)).collect();
        refused(format!("its networks have another shape: {}", differing.join(", ")))
    }

    fn check_rows(&self, config: &Config) -> Result<(), UsageError> {
        let there = self.run.path().display();
        let refused = |what: String| Err(UsageError(format!("--with-replay: {what}; leave out --with-replay")));
        let (old, new) = (&self.config, config);
        if config.algorithm.properties().transition_use != TransitionUse::Minibatches {
            return refused(format!(
                "{} learns from each step once, as it happens",
                config.algorithm.name()
            ));
        }
        for (what, old, new) in [
            (
                "γ",
                old.algorithm.gamma().to_string(),
                new.algorithm.gamma().to_string(),
            ),
            (
                "replay.n_step",
                old.replay.n_step.to_string(),
                new.replay.n_step.to_string(),
            ),
            (
                "the space of observations",
                format!("{:?}", old.spec.observation),
                format!("{:?}", new.spec.observation),
            ),
            (
                "the space of actions",
                format!("{:?}", old.spec.action),
                format!("{:?}", new.spec.action),
            ),
        ] {
            if old != new {
                return refused(format!(
                    "{what} is {old} in {there}, whose rows depend on it, and {new} here"
                ));
            }
        }
        Ok(())
    }

    fn write(&self, run: &RunDir, config: &Config) -> anyhow::Result<RunOrigin> {
        // The rows of the old replay that the new one begins with.
        let copied = match &self.replay {
            None => 0..0,
            Some((old, _)) => {
                let mut new = Replay::create(&run.replay_file(), &replay_layout(config))?;
                let count = new.inherit_rows(old, self.rows(old, config))?;
                let end = old.rows().end;
                end - count..end
            }
        };
        let rows = copied.end - copied.start;
        let Checkpoint { counters, arrays } = &self.checkpoint;
        let weight_names = registry::weight_names(config);
        let fresh = registry::new(config)?;
        let state = registry::inherited(&*fresh, &weight_names, SavedState::from(arrays.clone()), copied)?;
        let borrowed: Vec<(&str, &[f32])> = state
            .iter()
            .map(|(name, numbers)| (*name, numbers.as_slice()))
            .collect();
        let begun = Counters {
            rows,
            ..Counters::default()
        };
        Checkpoints::new(&run.checkpoints(), config.fingerprint()).save(&begun, &borrowed)?;
        Ok(RunOrigin {
            run: self.run.path().display().to_string(),
            env_steps: counters.rows,
            updates: counters.updates,
            weights_sha256: self.checkpoint.weights_sha256(config),
            rows,
        })
    }

    fn warning(&self, config: &Config) -> Option<String> {
        self.replay.as_ref()?;
        let own = |key: &str| key.starts_with("environment.") && key != "environment.server";
        let differences = self.config.differences(config).into_iter();
        let differing: Vec<String> = differences
            .filter(|it| own(&it.key))
            .map(|it| format!("{} = {} instead of {}", it.key, it.before, it.after))
            .collect();
        (!differing.is_empty()).then(|| {
            format!(
                "the rows of {} come from another environment: {}",
                self.run.path().display(),
                differing.join(", ")
            )
        })
    }
}

/// The keys that are part of the shapes of networks, with their values in this configuration.
pub(crate) fn shapes(config: &Config) -> anyhow::Result<Vec<(&'static str, String, toml::Value)>> {
    let table = toml::Table::try_from(config)?;
    let mut shapes = Vec::new();
    for section in explanation::sections() {
        let of_shape = section.keys.into_iter().filter(|key| key.change == Some(Change::Shape));
        for key in of_shape {
            let value = table.get(section.name).and_then(|values| values.get(&key.name));
            shapes.extend(value.map(|value| (section.name, key.name, value.clone())));
        }
    }
    Ok(shapes)
}
