//! Evaluation of a run's policies.

pub mod analysis;
pub mod best_policy;
pub mod earlier_best;
pub mod final_evaluation;
pub mod frames;
pub mod rollout;

use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use shoal_common::config::Config;
use shoal_common::numbers::mean_and_std;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;
use shoal_env_server::environment::Goal;

use self::rollout::{Rollout, policy_layout};
use crate::description;
use crate::signals::Interrupt;

/// One of the two policies that a run saves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum SavedPolicy {
    /// The policy with the best evaluation so far.
    #[default]
    Best,
    /// The learner's last policy.
    Last,
}

impl SavedPolicy {
    /// Reads this policy of a run. It must fit the run's network.
    pub fn read(self, run: &RunDir, config: &Config) -> anyhow::Result<PolicyFile> {
        Ok(PolicyFile::read(&self.path(run), &policy_layout(config)?)?)
    }

    /// As [`SavedPolicy::read`]; `None` if the run has no such policy.
    ///
    /// # Errors
    /// When it is unknown whether there is one, or it cannot be used.
    pub fn read_if_any(self, run: &RunDir, config: &Config) -> anyhow::Result<Option<PolicyFile>> {
        Ok(PolicyFile::read_if_any(&self.path(run), &policy_layout(config)?)?)
    }

    fn path(self, run: &RunDir) -> PathBuf {
        match self {
            Self::Best => run.best_policy(),
            Self::Last => run.last_policy(),
        }
    }
}

/// The result of an evaluation; the fields of `eval --json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EvaluationSummary {
    /// Mean of the episodes' returns.
    pub return_mean: f64,
    /// Standard deviation of the episodes' returns (n − 1); 0 for a single episode.
    pub return_std: f64,
    /// Number of episodes.
    pub episodes: u32,
    /// If the environment has a goal: the mean distance to it at the end, in the distance's unit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub final_distance_mean: Option<f64>,
    /// If the environment has a goal: the fraction of episodes that end at it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reached_fraction: Option<f64>,
}

impl EvaluationSummary {
    /// The policy with this evaluation.
    pub(crate) fn of_policy(&self, policy: &PolicyFile) -> PolicyFile {
        PolicyFile {
            return_mean: self.return_mean,
            return_std: self.return_std,
            episodes: self.episodes.into(),
            ..policy.clone()
        }
    }
}

/// Evaluation episodes: 0 … `count` − 1 of a seed. They start in the same states every time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct EpisodeSet {
    /// How many.
    pub count: u32,
    /// Their seed.
    pub seed: u64,
}

/// Runs the evaluation episodes 0 … `episodes` − 1 of `seed`. They start in the same states every time.
pub fn evaluate(config: &Config, parameters: &[f32], episodes: u32, seed: u64) -> anyhow::Result<EvaluationSummary> {
    let goal = description::of(config)?.goal;
    let episodes = EpisodeSet { count: episodes, seed };
    evaluate_by(Rollout::new(config, parameters)?, goal, episodes, |_| ())
}

/// As [`evaluate`], for a run: an environment that another program serves is started as in training. Calls `progress`
/// with the number of finished episodes.
///
/// # Errors
/// When the environment fails, or a signal has arrived.
pub fn evaluate_policy(
    run: &RunDir,
    config: &Config,
    parameters: &[f32],
    episodes: EpisodeSet,
    interrupt: &Interrupt,
    progress: impl FnMut(u32),
) -> anyhow::Result<EvaluationSummary> {
    let rollout = Rollout::of_run(run, config, parameters)?.interruptible_by(interrupt.clone());
    evaluate_by(rollout, description::of_run(run, config)?.goal, episodes, progress)
}

fn evaluate_by(
    mut rollout: Rollout<'_>,
    goal: Option<Goal>,
    episodes: EpisodeSet,
    mut progress: impl FnMut(u32),
) -> anyhow::Result<EvaluationSummary> {
    let (mut returns, mut distances) = (Vec::new(), Vec::new());
    for number in 0..episodes.count {
        let trajectory = rollout.evaluation_episode(episodes.seed, number.into())?;
        returns.push(trajectory.episode_return());
        progress(number + 1);
        if let Some(goal) = &goal {
            distances.extend(trajectory.values(goal.distance.source).last().copied());
        }
    }
    let reached = |goal: Goal| distances.iter().filter(|d| **d < goal.within).count() as f64;
    let (return_mean, return_std) = mean_and_std(&returns);
    Ok(EvaluationSummary {
        return_mean,
        return_std,
        episodes: episodes.count,
        final_distance_mean: goal.is_some().then(|| mean_and_std(&distances).0),
        reached_fraction: goal.map(|goal| reached(goal) / f64::from(episodes.count)),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small;
    use shoal_common::config::AlgorithmConfig;

    #[test]
    fn the_same_seed_gives_the_same_evaluation() {
        let (config, parameters) = small("name = \"pendulum\"");
        let first = evaluate(&config, &parameters, 5, 1).unwrap();
        assert_eq!(evaluate(&config, &parameters, 5, 1).unwrap(), first);
        assert_ne!(
            evaluate(&config, &parameters, 5, 2).unwrap().return_mean,
            first.return_mean
        );
        assert!((-2_000.0..0.0).contains(&first.return_mean) && first.return_std > 0.0);
        let keys = serde_json::to_string(&first).unwrap();
        assert!(!keys.contains("distance") && !keys.contains("reached"), "{keys}");
    }

    #[test]
    fn a_vehicle_without_force_ends_where_it_started() {
        let (config, mut parameters) = small("name = \"point-mass\"\nreward = \"r1\"");
        // The last bias belongs to the force: tanh(−20) gives the least force, 0.
        *parameters.last_mut().unwrap() = -20.0;
        let summary = evaluate(&config, &parameters, 50, 3).unwrap();
        // The mean distance of a square's points from its centre is 0.765 times half its side.
        let distance = summary.final_distance_mean.unwrap();
        assert!((2.4..3.7).contains(&distance), "{distance}");
        assert_eq!(summary.reached_fraction, Some(0.0));
    }

    #[test]
    fn a_policy_of_another_network_is_a_one_line_error() {
        let parent = tempfile::tempdir().unwrap();
        let run = RunDir::create(&parent.path().join("run")).unwrap();
        let (mut config, parameters) = small("name = \"pendulum\"");
        std::fs::write(run.config_file(), config.to_toml().unwrap()).unwrap();
        std::fs::create_dir(run.checkpoints()).unwrap();
        let missing = SavedPolicy::Best.read(&run, &config).unwrap_err().to_string();
        assert!(missing.contains("best.policy") && !missing.contains('\n'), "{missing}");

        let fingerprint = policy_layout(&config).unwrap().fingerprint();
        let policy = PolicyFile {
            fingerprint,
            version: 3,
            env_steps: 1_000,
            return_mean: -1_200.0,
            return_std: 300.0,
            episodes: 10,
            parameters,
        };
        policy.write(&run.last_policy()).unwrap();
        assert_eq!(SavedPolicy::Last.read(&run, &config).unwrap(), policy);
        let AlgorithmConfig::Ddpg(ddpg) = &mut config.algorithm else {
            unreachable!()
        };
        ddpg.hidden = [5, 3].into();
        let foreign = SavedPolicy::Last.read(&run, &config).unwrap_err().to_string();
        assert!(
            foreign.contains("another network") && !foreign.contains('\n'),
            "{foreign}"
        );
    }
}
