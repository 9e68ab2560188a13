//! Experiments that belong together: what is kept of a run, and what the report says of it.

use std::collections::BTreeMap;

use serde::Serialize;
use serde::de::DeserializeOwned;
use shoal_common::config::Config;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;
use shoal_run::evaluation::{WhichPolicy, evaluate};
use shoal_run::recorder::{EpisodeRecord, read_episodes, read_evaluations};

use super::album::{Album, Section};
use super::experiment::{Experiment, Length, Stage};
use super::folder::Folder;
use super::result::{Evaluation, Header, Policy, SeedResult};
use super::settings::RunSettings;

/// Experiments of one kind. Adding one takes this trait and a line in [`super::FAMILIES`].
pub(super) trait Family {
    /// What is kept of a run beside its evaluations: all that figures and claims need.
    type Tests: Serialize + DeserializeOwned;

    /// What is run.
    const EXPERIMENTS: &'static [Experiment];

    /// Tries the policies of a run that has just reached the end of `stage`.
    fn test(policies: &Policies, stage: &Stage) -> anyhow::Result<Self::Tests>;

    /// Checks the thesis's claims and draws its figures again, from results alone.
    fn sections(results: &Results<Self::Tests>, album: &Album) -> anyhow::Result<Vec<Section>>;
}

/// What a run has learned.
pub(super) struct Policies {
    pub(super) config: Config,
    /// With the best evaluation.
    pub(super) best: PolicyFile,
    /// As the learner left it.
    pub(super) last: PolicyFile,
    /// Where its records are.
    pub(super) run: RunDir,
}

impl Policies {
    /// The training's episodes in their order, of a run with one actor, one environment, and at most one episode in a chunk:
    /// then a policy is behind one of them at most. A chunk that was sent and not learned from when a run was interrupted is
    /// collected again, and its episode recorded again; and one that began when the run was over is none of it.
    pub(super) fn episodes(&self) -> anyhow::Result<Vec<EpisodeRecord>> {
        let mut episodes = read_episodes(&self.run.episodes())?;
        episodes.dedup_by_key(|episode| episode.policy_version);
        episodes.truncate(self.config.run.episodes.unwrap_or(u64::MAX) as usize);
        Ok(episodes)
    }
}

/// The results of a family that lie in a folder.
pub(super) struct Results<T> {
    by_name: BTreeMap<(&'static str, &'static str), Vec<SeedResult<T>>>,
}

impl<T> Results<T> {
    /// Those of an experiment's stage, in the order of their seeds.
    pub(super) fn of(&self, experiment: &'static str, suffix: &'static str) -> &[SeedResult<T>] {
        self.by_name.get(&(experiment, suffix)).map_or(&[], Vec::as_slice)
    }

    #[cfg(test)]
    pub(super) fn new() -> Self {
        let by_name = BTreeMap::new();
        Self { by_name }
    }

    #[cfg(test)]
    pub(super) fn put(&mut self, experiment: &'static str, suffix: &'static str, results: Vec<SeedResult<T>>) {
        self.by_name.insert((experiment, suffix), results);
    }
}

/// A family without its type, for lists.
#[derive(Debug)]
pub(super) struct Entry {
    pub(super) experiments: &'static [Experiment],
    /// Makes and keeps the result of a run that has reached the end of a stage.
    pub(super) keep: fn(&Folder, &'static Experiment, &Stage, u64, Length, &RunSettings) -> anyhow::Result<()>,
    /// What the report says, from the results in the folder.
    pub(super) sections: fn(&Folder, &Album) -> anyhow::Result<Vec<Section>>,
}

/// The entry of a family in a list.
pub(super) const fn entry<F: Family>() -> Entry {
    Entry {
        experiments: F::EXPERIMENTS,
        keep: keep::<F>,
        sections: sections::<F>,
    }
}

/// Makes the result of a run that has reached the end of `stage`, and keeps it in the folder.
fn keep<F: Family>(
    folder: &Folder,
    experiment: &'static Experiment,
    stage: &Stage,
    seed: u64,
    length: Length,
    settings: &RunSettings,
) -> anyhow::Result<()> {
    let run = RunDir::open(&folder.run(experiment, seed))?;
    let config = run.config()?;
    // Said by the run itself; it was checked to be what was expected.
    RunSettings::of_run(run.path(), seed)?.check(&run.path().display().to_string(), settings)?;
    let policies = Policies {
        best: WhichPolicy::Best.read(&run, &config)?,
        last: WhichPolicy::Last.read(&run, &config)?,
        config,
        run,
    };
    let run = &policies.run;
    let evaluate = |policy: &PolicyFile| -> anyhow::Result<Policy> {
        let config = &policies.config;
        let episodes = config.evaluation.final_episodes;
        Ok(Policy {
            steps: policy.env_steps,
            evaluation: evaluate(config, &policy.parameters, episodes, config.run.seed)?,
        })
    };
    let rows = read_evaluations(&run.evaluations())?.into_iter();
    let mut evaluations: Vec<Evaluation> = rows
        .map(|row| Evaluation {
            steps: row.env_steps,
            mean: row.return_mean,
            std: row.return_std,
        })
        .collect();
    evaluations.sort_by_key(|evaluation| evaluation.steps);
    let result = SeedResult {
        header: Header::new(experiment, seed, length, &RunSettings::of(&policies.config)?),
        evaluations,
        best: evaluate(&policies.best)?,
        last: evaluate(&policies.last)?,
        tests: F::test(&policies, stage)?,
    };
    folder.add(experiment, stage, &result)
}

fn sections<F: Family>(folder: &Folder, album: &Album) -> anyhow::Result<Vec<Section>> {
    let mut by_name = BTreeMap::new();
    for experiment in F::EXPERIMENTS {
        for stage in experiment.stages {
            by_name.insert((experiment.name, stage.suffix), folder.read(experiment, stage)?);
        }
    }
    F::sections(&Results { by_name }, album)
}
