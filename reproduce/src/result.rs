//! What is kept of a seed: a small file from which claims are judged and figures drawn long after the run is gone.

use std::io::Write;
use std::path::Path;

use anyhow::{Context, bail};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use shoal_common::durable::write_atomically;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;
use shoal_run::evaluation::{EvaluationSummary, WhichPolicy, evaluate};
use shoal_run::recorder::read_evaluations;

use super::experiment::{Experiment, Length, Stage};
use super::family::{Family, Policies};
use super::folder::Folder;
use super::settings::Settings;

/// The form of a result; raise it with every change of what a key means.
const SCHEMA: u32 = 1;

/// How a result came about.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Header {
    schema: u32,
    experiment: String,
    pub(super) seed: u64,
    /// Since the run's beginning.
    length: Length,
    /// The version of this program that made it.
    pub(super) shoal: String,
    settings: Settings,
}

/// A seed's result; `T` is what its family tests beyond the evaluations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct SeedResult<T> {
    #[serde(flatten)]
    pub(super) header: Header,
    /// Of the whole run, in order.
    pub(super) evaluations: Vec<Evaluation>,
    /// The policy with the best evaluation.
    pub(super) best: Policy,
    /// The policy at the end.
    pub(super) last: Policy,
    pub(super) tests: T,
}

/// An evaluation during training.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Evaluation {
    pub(super) steps: u64,
    pub(super) mean: f64,
    pub(super) std: f64,
}

/// A policy, and how it did in the final evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Policy {
    /// Environment steps it was learned from.
    pub(super) steps: u64,
    pub(super) evaluation: EvaluationSummary,
}

impl<T> SeedResult<T> {
    /// (environment steps, mean return) of every evaluation.
    pub(super) fn curve(&self) -> Vec<(u64, f64)> {
        self.evaluations.iter().map(|it| (it.steps, it.mean)).collect()
    }

    /// Mean of the last fifth of the evaluations, of one at least.
    pub(super) fn late_mean(&self) -> f64 {
        let late = &self.evaluations[self.evaluations.len() * 4 / 5..];
        late.iter().map(|it| it.mean).sum::<f64>() / late.len() as f64
    }

    /// The first evaluation's steps at which nine tenths of the way from the first to the best evaluation are made.
    pub(super) fn learned_by(&self) -> Option<u64> {
        let first = self.evaluations.first()?.mean;
        let best = self.evaluations.iter().map(|it| it.mean).fold(first, f64::max);
        let enough = first + 0.9 * (best - first);
        self.evaluations.iter().find(|it| it.mean >= enough).map(|it| it.steps)
    }
}

impl Header {
    pub(super) fn new(experiment: &Experiment, seed: u64, length: Length, settings: &Settings) -> Self {
        Self {
            schema: SCHEMA,
            experiment: experiment.name.into(),
            seed,
            length,
            shoal: env!("CARGO_PKG_VERSION").into(),
            settings: settings.clone(),
        }
    }

    /// Reads how the result at `path` came about.
    pub(super) fn read(path: &Path) -> anyhow::Result<Self> {
        /// What a result of any version has.
        #[derive(Deserialize)]
        struct Versioned {
            schema: u32,
        }
        let Versioned { schema } = parse(path)?;
        if schema != SCHEMA {
            bail!(
                "{} has schema {schema}, this program writes {SCHEMA}: remove it, or choose another directory with --out",
                path.display()
            );
        }
        parse(path)
    }

    /// Refuses a result that is not the one that would be made now under its name.
    pub(super) fn check(
        &self,
        path: &Path,
        experiment: &Experiment,
        seed: u64,
        length: Length,
        settings: &Settings,
    ) -> anyhow::Result<()> {
        let (found, wanted) = (
            (self.experiment.as_str(), self.seed, self.length),
            (experiment.name, seed, length),
        );
        if found != wanted {
            let say = |(name, seed, length): (&str, u64, Length)| format!("{name}, seed {seed}, {length}");
            bail!(
                "{} is the result of {}, not of {}: remove it, or choose another directory with --out",
                path.display(),
                say(found),
                say(wanted)
            );
        }
        self.settings.check(path, settings)
    }
}

/// Makes the result of a run that has reached the end of `stage`, and writes it: whole or not at all.
pub(super) fn keep<F: Family>(
    folder: &Folder,
    experiment: &'static Experiment,
    stage: &Stage,
    seed: u64,
    length: Length,
    settings: &Settings,
) -> anyhow::Result<()> {
    let run = RunDir::open(&folder.run(experiment, seed))?;
    let config = run.config()?;
    // Said by the run itself; it was checked to be what was expected.
    Settings::of_run(run.path(), seed)?.check(run.path(), settings)?;
    let policies = Policies {
        best: WhichPolicy::Best.read(&run, &config)?,
        last: WhichPolicy::Last.read(&run, &config)?,
        config,
        run,
    };
    let run = &policies.run;
    let judge = |policy: &PolicyFile| -> anyhow::Result<Policy> {
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
        header: Header::new(experiment, seed, length, &Settings::of(&policies.config)?),
        evaluations,
        best: judge(&policies.best)?,
        last: judge(&policies.last)?,
        tests: F::test(&policies, stage)?,
    };
    write(&result, &folder.result(experiment, stage, seed))
}

pub(super) fn write<T: Serialize>(result: &SeedResult<T>, path: &Path) -> anyhow::Result<()> {
    let text = serde_json::to_string(result)?;
    write_atomically(path, |file| writeln!(file, "{text}")).with_context(|| format!("cannot write {}", path.display()))
}

/// Reads a whole result.
pub(super) fn read<T: DeserializeOwned>(path: &Path) -> anyhow::Result<SeedResult<T>> {
    parse(path)
}

fn parse<T: DeserializeOwned>(path: &Path) -> anyhow::Result<T> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_str(&text).with_context(|| {
        format!(
            "{} is no result of this program: remove it to have it made again",
            path.display()
        )
    })
}

/// The result whose best policy did as the middle one of all: it stands for them in figures of a single run.
pub(super) fn representative<T>(results: &[SeedResult<T>]) -> Option<&SeedResult<T>> {
    let mut sorted: Vec<&SeedResult<T>> = results.iter().collect();
    sorted.sort_by(|a, b| {
        let value = |result: &SeedResult<T>| result.best.evaluation.return_mean;
        value(a).total_cmp(&value(b))
    });
    sorted.get(sorted.len().saturating_sub(1) / 2).copied()
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::experiment::Progress;
    use super::*;

    /// A result of this seed whose best policy has this return, and its last a slightly worse one.
    pub(crate) fn result<T>(experiment: &Experiment, seed: u64, return_mean: f64, tests: T) -> SeedResult<T> {
        let policy = |return_mean| Policy {
            steps: 1_000,
            evaluation: EvaluationSummary {
                return_mean,
                return_std: 1.0,
                episodes: 100,
                final_distance_mean: Some(0.01),
                reached_fraction: Some(0.99),
            },
        };
        let length = experiment.stages[0].length;
        let steps = length.done(Progress::default()).1;
        let evaluation = |i: u64| Evaluation {
            steps: i * steps / 20,
            mean: return_mean * i.min(10) as f64 / 10.0,
            std: 1.0,
        };
        SeedResult {
            header: Header::new(
                experiment,
                seed,
                length,
                &Settings::from_pairs(&[("ddpg.tau", "0.001")]),
            ),
            evaluations: (0..=20).map(evaluation).collect(),
            best: policy(return_mean),
            last: policy(return_mean - 1.0),
            tests,
        }
    }

    fn experiment() -> &'static Experiment {
        &super::super::pendulum::EXPERIMENTS[0]
    }

    #[test]
    fn a_result_reads_back() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("seed-3.json");
        let made = result(experiment(), 3, -150.25, vec![0.1, 3.25, -2e-5]);
        write(&made, &path).unwrap();
        assert_eq!(read::<Vec<f64>>(&path).unwrap(), made);
        let header = Header::read(&path).unwrap();
        assert_eq!(header, made.header);
        let settings = |tau| Settings::from_pairs(&[("ddpg.tau", tau), ("ddpg.new", "1")]);
        header
            .check(&path, experiment(), 3, Length::Steps(120_000), &settings("0.001"))
            .unwrap();

        let refused = |seed, steps, tau| {
            let error = header
                .check(&path, experiment(), seed, Length::Steps(steps), &settings(tau))
                .unwrap_err()
                .to_string();
            assert!(
                error.contains("seed-3.json") && error.contains("--out") && !error.contains('\n'),
                "{error}"
            );
            error
        };
        assert!(refused(4, 120_000, "0.001").contains("not of pendulum, seed 4"));
        assert!(refused(3, 400, "0.001").contains("400 steps"));
        assert!(refused(3, 120_000, "0.005").contains("ddpg.tau = 0.001, which is now 0.005"));
    }

    #[test]
    fn another_schema_and_no_result_at_all_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("seed-1.json");
        for (text, part) in [
            ("{\"schema\": 99}", "schema 99"),
            ("{\"schema\"", "no result"),
            ("[]", "no result"),
        ] {
            std::fs::write(&path, text).unwrap();
            let error = format!("{:#}", Header::read(&path).unwrap_err());
            assert!(
                error.contains(part) && error.contains("remove it") && !error.contains('\n'),
                "{error}"
            );
        }
    }

    #[test]
    fn a_curve_says_how_it_ends_and_when_it_rose() {
        let result = result(experiment(), 1, 100.0, ());
        assert_eq!(result.late_mean(), 100.0);
        assert_eq!(result.learned_by(), Some(9 * 120_000 / 20));
    }

    #[test]
    fn the_middle_seed_stands_for_all() {
        let results: Vec<_> = [(1, -200.0), (2, -100.0), (3, -150.0)]
            .map(|(seed, value)| result(experiment(), seed, value, ()))
            .into();
        assert_eq!(representative(&results).unwrap().header.seed, 3);
        assert_eq!(
            representative(&results[..2]).unwrap().header.seed,
            1,
            "the lower of two"
        );
        assert!(representative::<()>(&[]).is_none());
    }
}
