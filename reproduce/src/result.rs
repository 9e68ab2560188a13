//! The stored result of a seed. It is small, but enough to check claims and draw figures after the run has been
//! deleted.

use anyhow::{Context, bail};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use shoal_run::evaluation::EvaluationSummary;

use super::experiment::{Experiment, Length};
use super::results_file::ResultLine;
use super::settings::RunSettings;

/// The version of a result's format. Increase it whenever the meaning of a key changes.
const FORMAT: u32 = 1;

/// The run that a result belongs to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct ResultHeader {
    schema: u32,
    experiment: String,
    pub(super) seed: u64,
    /// Counted from the start of the run.
    length: Length,
    /// The version of Shoal that made the result.
    pub(super) shoal: String,
    settings: RunSettings,
}

/// A seed's result. `T` is what its family measures besides the evaluations.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct SeedResult<T> {
    #[serde(flatten)]
    pub(super) header: ResultHeader,
    /// All evaluations of the run, in order.
    pub(super) evaluations: Vec<Evaluation>,
    /// The policy with the best evaluation.
    pub(super) best: EvaluatedPolicy,
    /// The policy at the end.
    pub(super) last: EvaluatedPolicy,
    #[serde(rename = "tests")]
    pub(super) measurements: T,
}

/// An evaluation during training.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Evaluation {
    pub(super) steps: u64,
    pub(super) mean: f64,
    pub(super) std: f64,
}

/// A policy with its final evaluation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct EvaluatedPolicy {
    /// Environment steps at which it was learned.
    pub(super) steps: u64,
    pub(super) evaluation: EvaluationSummary,
}

impl<T> SeedResult<T> {
    /// (environment steps, mean return) of every evaluation.
    pub(super) fn curve(&self) -> Vec<(u64, f64)> {
        self.evaluations.iter().map(|it| (it.steps, it.mean)).collect()
    }

    /// Mean of the last fifth of the evaluations, at least one.
    pub(super) fn late_mean(&self) -> f64 {
        let late = &self.evaluations[self.evaluations.len() * 4 / 5..];
        late.iter().map(|it| it.mean).sum::<f64>() / late.len() as f64
    }

    /// The environment steps of the first evaluation that has covered nine tenths of the way from the first
    /// evaluation's mean return to the best one.
    pub(super) fn learned_by(&self) -> Option<u64> {
        let first = self.evaluations.first()?.mean;
        let best = self.evaluations.iter().map(|it| it.mean).fold(first, f64::max);
        let enough = first + 0.9 * (best - first);
        self.evaluations.iter().find(|it| it.mean >= enough).map(|it| it.steps)
    }
}

impl ResultHeader {
    pub(super) fn new(experiment: &Experiment, seed: u64, length: Length, settings: &RunSettings) -> Self {
        Self {
            schema: FORMAT,
            experiment: experiment.name.into(),
            seed,
            length,
            shoal: env!("CARGO_PKG_VERSION").into(),
            settings: settings.clone(),
        }
    }

    /// Reads the header of a result.
    pub(super) fn read(line: &ResultLine) -> anyhow::Result<Self> {
        /// The key that results of every version have.
        #[derive(Deserialize)]
        struct Versioned {
            schema: u32,
        }
        let Versioned { schema } = parse(line)?;
        if schema != FORMAT {
            bail!(
                "{} has schema {schema}; this program reads schema {FORMAT}: move the file away, or choose another \
                 directory with --out",
                line.place
            );
        }
        parse(line)
    }

    /// Returns an error if the result at `place` is not of this experiment, seed, length and settings.
    pub(super) fn check(
        &self,
        place: &str,
        experiment: &Experiment,
        seed: u64,
        length: Length,
        settings: &RunSettings,
    ) -> anyhow::Result<()> {
        let (found, expected) = (
            (self.experiment.as_str(), self.seed, self.length),
            (experiment.name, seed, length),
        );
        if found != expected {
            let describe = |(name, seed, length): (&str, u64, Length)| format!("{name}, seed {seed}, {length}");
            bail!(
                "{place} is the result of {}, not of {}: move the file or directory away, or choose another directory \
                 with --out",
                describe(found),
                describe(expected)
            );
        }
        self.settings.check(place, settings)
    }
}

/// Reads a whole result.
pub(super) fn read<T: DeserializeOwned>(line: &ResultLine) -> anyhow::Result<SeedResult<T>> {
    parse(line)
}

fn parse<T: DeserializeOwned>(line: &ResultLine) -> anyhow::Result<T> {
    serde_json::from_str(&line.text).with_context(|| {
        format!(
            "{} is not a result of this program: move the file away, and its results will be made again",
            line.place
        )
    })
}

/// The result whose best policy has the median final evaluation (the lower of the middle two). Figures of a single run
/// show it.
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

    /// A result of this seed. The best policy has this return, and the last policy a slightly lower one.
    pub(crate) fn result<T>(experiment: &Experiment, seed: u64, return_mean: f64, measurements: T) -> SeedResult<T> {
        let policy = |return_mean| EvaluatedPolicy {
            steps: 1_000,
            evaluation: EvaluationSummary {
                return_mean,
                return_std: 1.0,
                episodes: 100,
                final_distance_mean: Some(0.01),
                reached_fraction: Some(0.99),
            },
        };
        let length = experiment.milestones[0].length;
        let steps = length.done_and_total(Progress::default()).1;
        let evaluation = |i: u64| Evaluation {
            steps: i * steps / 20,
            mean: return_mean * i.min(10) as f64 / 10.0,
            std: 1.0,
        };
        SeedResult {
            header: ResultHeader::new(
                experiment,
                seed,
                length,
                &RunSettings::from_pairs(&[("ddpg.tau", "0.001")]),
            ),
            evaluations: (0..=20).map(evaluation).collect(),
            best: policy(return_mean),
            last: policy(return_mean - 1.0),
            measurements,
        }
    }

    fn experiment() -> &'static Experiment {
        &super::super::pendulum::EXPERIMENTS[0]
    }

    fn line(text: &str) -> ResultLine {
        ResultLine::at("pendulum.jsonl.gz (seed 3)", text)
    }

    #[test]
    fn a_written_result_can_be_read() {
        let made = result(experiment(), 3, -150.25, vec![0.1, 3.25, -2e-5]);
        let line = line(&serde_json::to_string(&made).unwrap());
        assert_eq!(read::<Vec<f64>>(&line).unwrap(), made);
        let header = ResultHeader::read(&line).unwrap();
        assert_eq!(header, made.header);
        let settings = |tau| RunSettings::from_pairs(&[("ddpg.tau", tau), ("ddpg.new", "1")]);
        header
            .check(&line.place, experiment(), 3, Length::Steps(120_000), &settings("0.001"))
            .unwrap();

        let refused = |seed, steps, tau| {
            let error = header
                .check(&line.place, experiment(), seed, Length::Steps(steps), &settings(tau))
                .unwrap_err()
                .to_string();
            assert!(
                error.contains("pendulum.jsonl.gz (seed 3)") && error.contains("--out") && !error.contains('\n'),
                "{error}"
            );
            error
        };
        assert!(refused(4, 120_000, "0.001").contains("not of pendulum, seed 4"));
        assert!(refused(3, 400, "0.001").contains("400 steps"));
        assert!(refused(3, 120_000, "0.005").contains("ddpg.tau = 0.001, which is now 0.005"));
    }

    #[test]
    fn another_schema_and_other_text_are_refused() {
        for (text, part) in [
            ("{\"schema\": 99}", "schema 99"),
            ("{\"schema\"", "not a result"),
            ("[]", "not a result"),
        ] {
            let error = format!("{:#}", ResultHeader::read(&line(text)).unwrap_err());
            assert!(
                error.contains(part) && error.contains("move the file away") && !error.contains('\n'),
                "{error}"
            );
        }
    }

    #[test]
    fn late_mean_and_learning_time_follow_from_the_curve() {
        let result = result(experiment(), 1, 100.0, ());
        assert_eq!(result.late_mean(), 100.0);
        assert_eq!(result.learned_by(), Some(9 * 120_000 / 20));
    }

    #[test]
    fn the_median_seed_represents_all() {
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
