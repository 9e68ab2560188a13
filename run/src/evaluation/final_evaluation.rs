//! The evaluation at the end of a run: `final-evaluation.json` in its directory, written atomically by the process that
//! has the run's lock.

use serde::{Deserialize, Serialize};
use shoal_common::run_dir::RunDir;
use shoal_common::versioned_file::VersionedFile;

use crate::evaluation::{EvaluationSummary, SavedPolicy};

/// What the final evaluation of a run found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FinalEvaluation {
    /// The seed of the start states.
    pub seed: u64,
    /// The run's environment steps at the evaluation. A run with more steps has been resumed since.
    pub env_steps: u64,
    /// The evaluated policies.
    pub policies: Vec<FinalPolicyResult>,
    /// The better policy by this evaluation, which then became `best.policy`.
    pub kept: SavedPolicy,
}

/// A policy's result in the final evaluation. A number that is not finite is `None`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FinalPolicyResult {
    /// Whether it was the best or the last policy when it was evaluated.
    pub policy: SavedPolicy,
    /// Its version.
    pub version: u64,
    /// Environment steps that it was learned from.
    pub env_steps: u64,
    /// Mean of the episodes' returns.
    pub return_mean: Option<f64>,
    /// Their standard deviation (n − 1).
    pub return_std: Option<f64>,
    /// Number of episodes.
    pub episodes: u32,
    /// The 95 % interval of the mean, by Student's t; `None` for a single episode.
    pub interval: Option<(f64, f64)>,
}

impl VersionedFile for FinalEvaluation {
    const FORMAT: u32 = 1;
    const IF_DAMAGED: &'static str = "; delete it: nothing else depends on it";
}

impl FinalPolicyResult {
    /// The entry of a policy of this version and number of environment steps.
    pub fn new(policy: SavedPolicy, (version, env_steps): (u64, u64), summary: &EvaluationSummary) -> Self {
        let finite = |number: f64| Some(number).filter(|number| number.is_finite());
        Self {
            policy,
            version,
            env_steps,
            return_mean: finite(summary.return_mean),
            return_std: finite(summary.return_std),
            episodes: summary.episodes,
            interval: interval(summary),
        }
    }
}

impl FinalEvaluation {
    /// The final evaluation of a run with this number of environment steps.
    pub fn new(seed: u64, env_steps: u64, policies: Vec<FinalPolicyResult>, kept: SavedPolicy) -> Self {
        Self {
            seed,
            env_steps,
            policies,
            kept,
        }
    }

    /// The result of the policy that now has this name.
    pub fn of(&self, which: SavedPolicy) -> Option<&FinalPolicyResult> {
        let policy = match which {
            SavedPolicy::Best => self.kept,
            SavedPolicy::Last => SavedPolicy::Last,
        };
        self.policies.iter().find(|evaluated| evaluated.policy == policy)
    }

    /// The final evaluation of a run that has `env_steps` environment steps; `None` if there is none, or if the run was
    /// resumed since.
    ///
    /// # Errors
    /// When the file cannot be read, is damaged or has another format.
    pub fn read(run: &RunDir, env_steps: u64) -> anyhow::Result<Option<Self>> {
        let read = Self::load_if_any(&run.final_evaluation())?;
        Ok(read.filter(|read| read.env_steps >= env_steps))
    }

    /// Writes it atomically.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, run: &RunDir) -> anyhow::Result<()> {
        Ok(self.store(&run.final_evaluation())?)
    }
}

/// The 97.5 % quantiles of Student's t for 1, 2, … degrees of freedom.
const STUDENT: [f64; 30] = [
    12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.262, 2.228, 2.201, 2.179, 2.160, 2.145, 2.131, 2.120,
    2.110, 2.101, 2.093, 2.086, 2.080, 2.074, 2.069, 2.064, 2.060, 2.056, 2.052, 2.048, 2.045, 2.042,
];

fn interval(summary: &EvaluationSummary) -> Option<(f64, f64)> {
    let freedom = summary.episodes.checked_sub(1).filter(|freedom| *freedom > 0)?;
    // Beyond the table: the first terms of the quantile's expansion in 1/ν.
    let t = STUDENT
        .get(freedom as usize - 1)
        .copied()
        .unwrap_or_else(|| 1.959_964 + 2.372_27 / f64::from(freedom));
    let half = t * summary.return_std / f64::from(summary.episodes).sqrt();
    let (low, high) = (summary.return_mean - half, summary.return_mean + half);
    (low.is_finite() && high.is_finite()).then_some((low, high))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn summary(return_mean: f64, return_std: f64, episodes: u32) -> EvaluationSummary {
        EvaluationSummary {
            return_mean,
            return_std,
            episodes,
            final_distance_mean: None,
            reached_fraction: None,
        }
    }

    #[test]
    fn the_interval_is_students() {
        let (low, high) = interval(&summary(-150.0, 10.0, 100)).unwrap();
        assert!(
            (high + 150.0 - 1.984_217).abs() < 1e-3 && (low + high + 300.0).abs() < 1e-9,
            "{high}"
        );
        assert_eq!(
            interval(&summary(1.0, 2.0, 2)).unwrap().1,
            1.0 + 12.706 * 2.0 / 2.0_f64.sqrt()
        );
        assert_eq!(interval(&summary(1.0, 0.0, 1)), None);
        assert_eq!(interval(&summary(f64::NAN, 0.0, 9)), None);
    }

    #[test]
    fn it_reads_back_until_the_run_has_more_steps() {
        let parent = tempfile::tempdir().unwrap();
        let run = RunDir::create(&parent.path().join("run")).unwrap();
        assert_eq!(FinalEvaluation::read(&run, 10).unwrap(), None);
        let policies = vec![
            FinalPolicyResult::new(SavedPolicy::Best, (3, 5), &summary(f64::NAN, 0.0, 9)),
            FinalPolicyResult::new(SavedPolicy::Last, (4, 10), &summary(-1.0, 0.5, 9)),
        ];
        let written = FinalEvaluation::new(1, 10, policies, SavedPolicy::Last);
        written.write(&run).unwrap();
        assert_eq!(FinalEvaluation::read(&run, 10).unwrap(), Some(written.clone()));
        assert_eq!(FinalEvaluation::read(&run, 11).unwrap(), None);
        assert_eq!(written.of(SavedPolicy::Best).unwrap().version, 4);
        assert_eq!(written.policies[0].return_mean, None);
        let other = std::fs::read_to_string(run.final_evaluation()).unwrap();
        let other = other.replace("\"format\":1", "\"format\":2");
        std::fs::write(run.final_evaluation(), other).unwrap();
        let refused = FinalEvaluation::read(&run, 10).unwrap_err().to_string();
        assert!(refused.contains("format 2") && !refused.contains('\n'), "{refused}");
    }
}
