//! Whole episodes of a policy without exploration, in this process: what `eval` judges and `plot` draws.

use anyhow::{Context, ensure};
use shoal_common::channel::environment::StepBlocks;
use shoal_common::config::Config;
use shoal_common::policy::{Policy, PolicyLayout};
use shoal_common::space::EnvironmentSpec;
use shoal_env_server::vector::{Start, VectorEnvironment};

/// An episode of T steps.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Trajectory {
    /// T + 1 of them, the one after the last step included.
    pub(crate) observations: Vec<Vec<f32>>,
    /// T actions, in environment units.
    pub(crate) actions: Vec<Vec<f32>>,
    /// T rewards.
    pub(crate) rewards: Vec<f64>,
    /// The last state is terminal; otherwise the time limit ended the episode.
    pub(crate) terminated: bool,
}

impl Trajectory {
    /// The sum of the rewards, undiscounted.
    pub(crate) fn episode_return(&self) -> f64 {
        self.rewards.iter().sum()
    }
}

/// A policy, and an environment of the run to try it in.
pub(crate) struct Rollout<'a> {
    environment: VectorEnvironment,
    policy: Policy,
    parameters: &'a [f32],
}

impl<'a> Rollout<'a> {
    /// The environment and network of `config`, with these parameters.
    pub(crate) fn new(config: &Config, parameters: &'a [f32]) -> anyhow::Result<Self> {
        let policy = policy_of(config)?;
        let expected = policy.layout().parameters();
        let found = parameters.len();
        ensure!(
            found == expected,
            "the policy has {found} parameters, the run's network {expected}"
        );
        let environment = environment_of(config)?;
        let name = &config.environment.name;
        // Here no state is saved, and runs of older builds do not know its width.
        let said = EnvironmentSpec {
            state_width: config.spec.state_width,
            ..environment.spec().clone()
        };
        ensure!(
            said == config.spec,
            "config.toml: [spec] is not what environment {name} says of itself"
        );
        Ok(Self {
            environment,
            policy,
            parameters,
        })
    }

    /// Runs evaluation episode `number` of `seed`: it starts where every evaluation's episode of this number starts.
    pub(crate) fn evaluation_episode(&mut self, seed: u64, number: u64) -> anyhow::Result<Trajectory> {
        self.episode(Start::Evaluation { seed, first: number })
    }

    /// Runs an episode that starts in a physical state of the environment.
    pub(crate) fn episode_from(&mut self, state: &[f64]) -> anyhow::Result<Trajectory> {
        self.episode(Start::States(state))
    }

    fn episode(&mut self, start: Start<'_>) -> anyhow::Result<Trajectory> {
        let width = self.environment.spec().observation.width();
        let (mut observation, mut next) = (vec![0.0; width], vec![0.0; width]);
        let mut action = vec![0.0; self.environment.spec().action.width()];
        self.environment.reset(start, &mut observation)?;
        let mut trajectory = Trajectory {
            observations: vec![observation.clone()],
            ..Trajectory::default()
        };
        loop {
            self.policy.act(self.parameters, &observation, &mut action);
            let (mut reward, mut terminated, mut truncated) = ([0.0], [0.0], [0.0]);
            let blocks = StepBlocks {
                observations: &mut observation,
                next_observations: &mut next,
                rewards: &mut reward,
                terminated: &mut terminated,
                truncated: &mut truncated,
            };
            self.environment.step(&action, blocks)?;
            trajectory.observations.push(next.clone());
            trajectory.actions.push(action.clone());
            trajectory.rewards.push(reward[0].into());
            if terminated[0] != 0.0 || truncated[0] != 0.0 {
                trajectory.terminated = terminated[0] != 0.0;
                return Ok(trajectory);
            }
        }
    }
}

/// What a policy file of this run must hold.
pub(crate) fn policy_layout(config: &Config) -> anyhow::Result<PolicyLayout> {
    PolicyLayout::new(&config.algorithm, &config.spec).with_context(|| config.environment.name.clone())
}

fn policy_of(config: &Config) -> anyhow::Result<Policy> {
    Policy::new(&config.algorithm, &config.spec, 1).with_context(|| config.environment.name.clone())
}

fn environment_of(config: &Config) -> anyhow::Result<VectorEnvironment> {
    let (name, parameters) = (&config.environment.name, &config.environment.parameters);
    Ok(VectorEnvironment::new(name, parameters, 1, config.run.seed, 0, 0)?)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use shoal_env_server::environment::make;

    /// A small configuration for tests, and a policy for it that always takes the action in the middle of its range.
    pub(crate) fn small(environment: &str) -> (Config, Vec<f32>) {
        let text = format!("[run]\nid = \"1a\"\n[environment]\n{environment}\n[ddpg]\nhidden = [4, 3]\n");
        let mut table: toml::Table = text.parse().unwrap();
        let mut parameters = table["environment"].as_table().unwrap().clone();
        let name = parameters.remove("name").unwrap();
        let spec = make(name.as_str().unwrap(), &parameters).unwrap().spec();
        table.insert("spec".into(), toml::Value::try_from(spec).unwrap());
        let config = Config::from_table(table, "test").unwrap();
        let parameters = vec![0.0; policy_of(&config).unwrap().layout().parameters()];
        (config, parameters)
    }

    #[test]
    fn an_episode_ends_with_its_time_limit() {
        let (config, parameters) = small("name = \"pendulum\"\ntime_limit = 30");
        let mut rollout = Rollout::new(&config, &parameters).unwrap();
        let hanging = rollout.episode_from(&[std::f64::consts::PI, 0.0]).unwrap();
        assert_eq!(
            (hanging.observations.len(), hanging.actions.len(), hanging.rewards.len()),
            (31, 30, 30)
        );
        assert!(!hanging.terminated);
        assert!(hanging.actions.iter().all(|action| action == &[0.0]));
        assert!(
            (hanging.episode_return() + 30.0 * std::f64::consts::PI.powi(2)).abs() < 1e-3,
            "it stays at the bottom"
        );
    }

    #[test]
    fn an_evaluation_episode_depends_on_seed_and_number_alone() {
        let (config, parameters) = small("name = \"point-mass\"\nreward = \"r1\"");
        let mut rollout = Rollout::new(&config, &parameters).unwrap();
        let first = rollout.evaluation_episode(1, 0).unwrap();
        let second = rollout.evaluation_episode(1, 1).unwrap();
        assert_ne!(first.observations[0], second.observations[0]);
        assert_ne!(
            first.observations[0],
            rollout.evaluation_episode(2, 0).unwrap().observations[0]
        );
        assert_eq!(rollout.evaluation_episode(1, 0).unwrap(), first);
        assert_eq!(
            Rollout::new(&config, &parameters)
                .unwrap()
                .evaluation_episode(1, 1)
                .unwrap(),
            second
        );
    }

    #[test]
    fn what_does_not_fit_is_refused_in_one_line() {
        let (config, parameters) = small("name = \"pendulum\"");
        let short = Rollout::new(&config, &parameters[1..]).err().unwrap();
        assert_eq!(short.to_string(), "the policy has 34 parameters, the run's network 35");
        let diverged = vec![f32::NAN; parameters.len()];
        let diverged = Rollout::new(&config, &diverged)
            .unwrap()
            .evaluation_episode(1, 0)
            .unwrap_err();
        assert!(diverged.to_string().contains("diverging"), "{diverged}");
    }
}
