//! `shoal eval`: how good a run's policy is.

use std::io::Write;

use comfy_table::Table;
use comfy_table::presets::UTF8_BORDERS_ONLY;
use serde::{Deserialize, Serialize};
use shoal_actor::evaluator::mean_and_std;
use shoal_common::config::Config;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::RunDir;

use crate::cli::EvalArgs;
use crate::rollout::{Rollout, Trajectory, policy_layout};
use crate::test_run::point_mass::REACHED;

/// One of a run's policies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum WhichPolicy {
    /// With the best evaluation so far.
    #[default]
    Best,
    /// As the learner left it.
    Last,
}

impl WhichPolicy {
    /// Reads this policy of a run; it must be for the run's network.
    pub(crate) fn read(self, run: &RunDir, config: &Config) -> anyhow::Result<PolicyFile> {
        let path = match self {
            Self::Best => run.best_policy(),
            Self::Last => run.last_policy(),
        };
        Ok(PolicyFile::read(&path, &policy_layout(config)?)?)
    }
}

/// How a policy did; the fields of `eval --json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct EvaluationSummary {
    pub(crate) return_mean: f64,
    /// Of the sample: n − 1. 0 for a single episode.
    pub(crate) return_std: f64,
    pub(crate) episodes: u32,
    /// Of a point mass: the mean distance to the goal at the end, in m.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) final_distance_mean: Option<f64>,
    /// Of a point mass: the share of episodes that end within 0.05 m of the goal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) reached_fraction: Option<f64>,
}

/// Runs the evaluation episodes 0 … `episodes` − 1 of `seed`, the same start states every time.
pub(crate) fn evaluate(
    config: &Config,
    parameters: &[f32],
    episodes: u32,
    seed: u64,
) -> anyhow::Result<EvaluationSummary> {
    let mut rollout = Rollout::new(config, parameters)?;
    let (mut returns, mut distances) = (Vec::new(), Vec::new());
    for number in 0..episodes {
        let trajectory = rollout.evaluation_episode(seed, number.into())?;
        returns.push(trajectory.episode_return());
        distances.extend(final_distance(config, &trajectory));
    }
    let reached = distances.iter().filter(|d| **d < REACHED).count() as f64;
    let point_mass = !distances.is_empty();
    let (return_mean, return_std) = mean_and_std(&returns);
    Ok(EvaluationSummary {
        return_mean,
        return_std,
        episodes,
        final_distance_mean: point_mass.then(|| mean_and_std(&distances).0),
        reached_fraction: point_mass.then(|| reached / distances.len() as f64),
    })
}

/// Judges a policy and tells the person, or a script, how it did.
pub(crate) fn run(args: &EvalArgs) -> anyhow::Result<()> {
    let run = RunDir::open(&args.run)?;
    let config = run.config()?;
    let policy = args.policy.read(&run, &config)?;
    let seed = args.seed.unwrap_or(config.run.seed);
    let summary = evaluate(&config, &policy.parameters, args.episodes, seed)?;
    let table = table(&summary, &policy, seed);
    if args.json {
        writeln!(std::io::stderr().lock(), "{table}")?;
        writeln!(std::io::stdout().lock(), "{}", serde_json::to_string(&summary)?)?;
    } else {
        writeln!(std::io::stdout().lock(), "{table}")?;
    }
    Ok(())
}

fn table(summary: &EvaluationSummary, policy: &PolicyFile, seed: u64) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    let mut row = |name: &str, value: String| {
        table.add_row([name.to_owned(), value]);
    };
    row(
        "policy",
        format!(
            "version {}, learned from {} environment steps",
            policy.version, policy.env_steps
        ),
    );
    row(
        "episodes",
        format!("{} from the start states of seed {seed}", summary.episodes),
    );
    row(
        "return",
        format!(
            "{:.2} ± {:.2} (mean ± standard deviation)",
            summary.return_mean, summary.return_std
        ),
    );
    if let Some(distance) = summary.final_distance_mean {
        row("distance at the end", format!("{distance:.4} m in the mean"));
    }
    if let Some(reached) = summary.reached_fraction {
        row(
            "goal reached",
            format!(
                "{:.0} % of the episodes (within {REACHED} m at the end)",
                100.0 * reached
            ),
        );
    }
    table
}

/// d at an episode's end: the fifth number of a point mass's observation (equation 5.7).
fn final_distance(config: &Config, trajectory: &Trajectory) -> Option<f64> {
    (config.environment.name == "point-mass").then(|| trajectory.observations.last()?.get(4).copied().map(f64::from))?
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rollout::tests::small;
    use shoal_common::config::Algorithm;

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
    fn a_vehicle_that_never_moves_ends_where_it_started() {
        let (config, mut parameters) = small("name = \"point-mass\"\nreward = \"r1\"");
        // The last bias is the force's: tanh(−20) is the least force, 0.
        *parameters.last_mut().unwrap() = -20.0;
        let summary = evaluate(&config, &parameters, 50, 3).unwrap();
        // The mean distance of a square's points from its centre is 0.765 half sides.
        let distance = summary.final_distance_mean.unwrap();
        assert!((2.4..3.7).contains(&distance), "{distance}");
        assert_eq!(summary.reached_fraction, Some(0.0));
    }

    #[test]
    fn a_policy_of_another_network_is_refused_in_one_line() {
        let parent = tempfile::tempdir().unwrap();
        let run = RunDir::create(&parent.path().join("run")).unwrap();
        let (mut config, parameters) = small("name = \"pendulum\"");
        std::fs::write(run.config_file(), config.to_toml().unwrap()).unwrap();
        std::fs::create_dir(run.checkpoints()).unwrap();
        let missing = WhichPolicy::Best.read(&run, &config).unwrap_err().to_string();
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
        assert_eq!(WhichPolicy::Last.read(&run, &config).unwrap(), policy);
        let args = EvalArgs {
            run: run.path().into(),
            policy: WhichPolicy::Last,
            episodes: 2,
            seed: None,
            json: true,
        };
        super::run(&args).unwrap();

        let Algorithm::Ddpg(ddpg) = &mut config.algorithm else {
            unreachable!()
        };
        ddpg.hidden = [5, 3];
        let foreign = WhichPolicy::Last.read(&run, &config).unwrap_err().to_string();
        assert!(
            foreign.contains("another network") && !foreign.contains('\n'),
            "{foreign}"
        );
    }
}
