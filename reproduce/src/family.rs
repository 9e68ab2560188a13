//! Families of related experiments: what is stored of a run, and what the report contains.

use std::collections::BTreeMap;

use anyhow::ensure;
use serde::Serialize;
use serde::de::DeserializeOwned;
use shoal_common::config::Config;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;
use shoal_run::evaluation::best_policy::evaluate_and_keep_best;
use shoal_run::evaluation::final_evaluation::FinalEvaluation;
use shoal_run::evaluation::{SavedPolicy, evaluate};
use shoal_run::records::recorder::{EpisodeRecord, read_episodes, read_evaluations};
use shoal_run::signals::Interrupt;
use shoal_run::status::saved_status;

use super::experiment::{Experiment, Length, Milestone};
use super::folder::Folder;
use super::report_section::{FigureWriter, ReportSection};
use super::result::{EvaluatedPolicy, Evaluation, ResultHeader, SeedResult};
use super::settings::RunSettings;

/// A family of related experiments. A new family implements this trait and has a line in [`super::FAMILIES`].
pub(super) trait Family {
    /// What is stored of a run besides its evaluations: everything that figures and claims need.
    type Measurements: Serialize + DeserializeOwned;

    /// The experiments of this family.
    const EXPERIMENTS: &'static [Experiment];

    /// Measures a run that has just reached `milestone`.
    fn measure(trained: &TrainedRun, milestone: &Milestone) -> anyhow::Result<Self::Measurements>;

    /// Checks the thesis's claims and draws its figures, from stored results alone.
    fn sections(results: &Results<Self::Measurements>, writer: &FigureWriter) -> anyhow::Result<Vec<ReportSection>>;
}

/// A trained run and its policies.
pub(super) struct TrainedRun {
    pub(super) config: Config,
    /// The policy with the best evaluation.
    pub(super) best: PolicyFile,
    /// The policy at the end of the training.
    pub(super) last: PolicyFile,
    pub(super) run: RunDir,
}

impl TrainedRun {
    /// Opens a trained run, which must have these settings. An interrupted final evaluation is completed.
    fn open(folder: &Folder, experiment: &Experiment, seed: u64, settings: &RunSettings) -> anyhow::Result<Self> {
        let run = RunDir::open(&folder.run(experiment, seed))?;
        let config = run.config()?;
        // The result's header states the settings of the run itself, so they must be the expected ones.
        RunSettings::of_run(run.path(), seed)?.check(&run.path().display().to_string(), settings)?;
        let steps = saved_status(&config, &run)?.env_steps;
        if FinalEvaluation::read(&run, steps)?.is_none() {
            // It was interrupted.
            evaluate_and_keep_best(&config, &run.lock()?, steps, &Interrupt::default(), |_, _| ())?;
        }
        Ok(Self {
            best: SavedPolicy::Best.read(&run, &config)?,
            last: SavedPolicy::Last.read(&run, &config)?,
            config,
            run,
        })
    }

    /// The training's episodes in order. This requires a run with one actor, one environment and at most one episode
    /// per chunk, so that every episode has its own policy version. If a run is interrupted before the learner uses a
    /// chunk, its episode is collected and recorded again; such duplicates are removed, and so are episodes beyond the
    /// run's end.
    ///
    /// # Errors
    /// When they cannot be read, or some are missing.
    pub(super) fn episodes(&self) -> anyhow::Result<Vec<EpisodeRecord>> {
        let mut episodes = read_episodes(&self.run.episodes())?;
        episodes.dedup_by_key(|episode| episode.policy_version);
        episodes.truncate(self.config.run.episodes.unwrap_or(u64::MAX) as usize);
        let (recorded, ended) = (episodes.len() as u64, saved_status(&self.config, &self.run)?.episodes);
        ensure!(
            recorded >= ended.min(self.config.run.episodes.unwrap_or(u64::MAX)),
            "{}: episodes.csv has {recorded} of {ended} episodes, because a launcher was killed: remove this \
             directory, and repeat the command",
            self.run.path().display()
        );
        Ok(episodes)
    }
}

/// All stored results of a family.
pub(super) struct Results<T> {
    by_name: BTreeMap<(&'static str, &'static str), Vec<SeedResult<T>>>,
}

impl<T> Results<T> {
    /// The results of a milestone of an experiment, ordered by seed.
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

/// A [`Family`] without its type, so that a list can contain different families.
#[derive(Debug)]
pub(super) struct FamilyEntry {
    pub(super) experiments: &'static [Experiment],
    /// Makes and stores the result of a run that has reached a milestone.
    pub(super) store_result:
        fn(&Folder, &'static Experiment, &Milestone, u64, Length, &RunSettings) -> anyhow::Result<()>,
    /// Makes the report's sections from the results in the folder.
    pub(super) sections: fn(&Folder, &FigureWriter) -> anyhow::Result<Vec<ReportSection>>,
}

/// The [`FamilyEntry`] of a family.
pub(super) const fn entry<F: Family>() -> FamilyEntry {
    FamilyEntry {
        experiments: F::EXPERIMENTS,
        store_result: store_result::<F>,
        sections: sections::<F>,
    }
}

/// Makes the result of a run that has reached `milestone`, and stores it in the folder.
fn store_result<F: Family>(
    folder: &Folder,
    experiment: &'static Experiment,
    milestone: &Milestone,
    seed: u64,
    length: Length,
    settings: &RunSettings,
) -> anyhow::Result<()> {
    let trained = TrainedRun::open(folder, experiment, seed, settings)?;
    let evaluate = |policy: &PolicyFile| -> anyhow::Result<EvaluatedPolicy> {
        let config = &trained.config;
        let episodes = config.evaluation.final_episodes;
        Ok(EvaluatedPolicy {
            steps: policy.env_steps,
            evaluation: evaluate(config, &policy.parameters, episodes, config.run.seed)?,
        })
    };
    let mut evaluations: Vec<Evaluation> = read_evaluations(&trained.run.evaluations())?
        .into_iter()
        .map(|row| Evaluation {
            steps: row.env_steps,
            mean: row.return_mean,
            std: row.return_std,
        })
        .collect();
    evaluations.sort_by_key(|evaluation| evaluation.steps);
    let result = SeedResult {
        header: ResultHeader::new(experiment, seed, length, &RunSettings::of(&trained.config)?),
        evaluations,
        best: evaluate(&trained.best)?,
        last: evaluate(&trained.last)?,
        measurements: F::measure(&trained, milestone)?,
    };
    folder.add(experiment, milestone, &result)
}

fn sections<F: Family>(folder: &Folder, writer: &FigureWriter) -> anyhow::Result<Vec<ReportSection>> {
    let mut by_name = BTreeMap::new();
    for experiment in F::EXPERIMENTS {
        for milestone in experiment.milestones {
            by_name.insert((experiment.name, milestone.suffix), folder.read(experiment, milestone)?);
        }
    }
    F::sections(&Results { by_name }, writer)
}
