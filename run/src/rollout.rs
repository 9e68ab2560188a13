//! Whole episodes of a policy without exploration: what `eval` evaluates and `plot` draws. Our own environments are stepped
//! in this process, others by their servers.

use anyhow::{Context, bail, ensure};
use shoal_common::channel::environment::StepBlocks;
use shoal_common::config::Config;
use shoal_common::policy::{Policy, PolicyLayout};
use shoal_common::space::EnvironmentSpec;
use shoal_env_server::environment::Source;
use shoal_env_server::environment::angle::followed;
use shoal_env_server::vector::{Start, VectorEnvironment};

use crate::external_environment::ExternalEnvironment;
use crate::signals::Interrupt;

/// How often an episode is run that another program's failure breaks, each time with a program started anew.
const TRIES: u32 = 5;

/// An episode of T steps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// T + 1 of them, the one after the last step included.
    pub observations: Vec<Vec<f32>>,
    /// T actions, in environment units.
    pub actions: Vec<Vec<f32>>,
    /// T rewards.
    pub rewards: Vec<f64>,
    /// The last state is terminal; otherwise the time limit ended the episode.
    pub terminated: bool,
}

impl Trajectory {
    /// The sum of the rewards, undiscounted.
    pub fn episode_return(&self) -> f64 {
        self.rewards.iter().sum()
    }

    /// A signal's values: T + 1 of what is observed, T of an action. NaN where there is no such number.
    pub fn values(&self, source: Source) -> Vec<f64> {
        let number = |row: &Vec<f32>, i: usize| row.get(i).map_or(f64::NAN, |number| f64::from(*number));
        match source {
            Source::Observation(i) => self.observations.iter().map(|row| number(row, i)).collect(),
            Source::Action(i) => self.actions.iter().map(|row| number(row, i)).collect(),
            Source::Angle { cos, sin } => {
                let seen = self
                    .observations
                    .iter()
                    .map(|row| number(row, sin).atan2(number(row, cos)));
                let first = seen.clone().next().unwrap_or_default();
                followed(seen, first)
            }
        }
    }
}

/// A policy, and an environment of the run to try it in.
pub struct Rollout<'a> {
    config: &'a Config,
    stage: Stage,
    policy: Policy,
    parameters: &'a [f32],
    interrupt: Interrupt,
}

/// Where one environment is stepped.
enum Stage {
    Here(Box<VectorEnvironment>),
    /// By another program, whose evaluation episodes start as this seed says. Begun with the first episode.
    Elsewhere(Option<(u64, Box<ExternalEnvironment>)>),
}

/// What a step gave.
struct RolloutStep {
    s_next: Vec<f32>,
    reward: f64,
    terminated: bool,
    truncated: bool,
}

impl<'a> Rollout<'a> {
    /// The environment and network of `config`, with these parameters.
    pub fn new(config: &'a Config, parameters: &'a [f32]) -> anyhow::Result<Self> {
        let policy = policy_of(config)?;
        let expected = policy.layout().parameters();
        let found = parameters.len();
        ensure!(
            found == expected,
            "the policy has {found} parameters, the run's network {expected}"
        );
        Ok(Self {
            config,
            stage: Stage::of(config)?,
            policy,
            parameters,
            interrupt: Interrupt::default(),
        })
    }

    /// Ends an episode with an error once a signal has come.
    pub fn until(self, interrupt: Interrupt) -> Self {
        Self { interrupt, ..self }
    }

    /// Runs evaluation episode `number` of `seed`: it starts where every evaluation's episode of this number starts.
    pub fn evaluation_episode(&mut self, seed: u64, number: u64) -> anyhow::Result<Trajectory> {
        self.episode(Start::Evaluation {
            seed,
            first: number,
            episodes: Some(1),
        })
    }

    /// Runs an episode that starts in a physical state of the environment, which must be one of ours.
    pub fn episode_from(&mut self, state: &[f64]) -> anyhow::Result<Trajectory> {
        self.episode(Start::States(state))
    }

    /// An episode that the environment's program breaks is run again by a program that is started anew.
    fn episode(&mut self, start: Start<'_>) -> anyhow::Result<Trajectory> {
        let mut tries = 1;
        loop {
            match self.try_episode(start) {
                Err(_) if tries < TRIES && self.interrupt.signal().is_none() && self.stage.may_be_started_anew() => {
                    tries += 1;
                }
                Err(error) if tries > 1 => bail!("{error:#} (the episode was begun {tries} times)"),
                result => return result,
            }
        }
    }

    fn try_episode(&mut self, start: Start<'_>) -> anyhow::Result<Trajectory> {
        let mut observation = self.stage.begin(self.config, start, &self.interrupt)?;
        let mut action = vec![0.0; self.config.spec.action.width()];
        let mut trajectory = Trajectory {
            observations: vec![observation.clone()],
            ..Trajectory::default()
        };
        loop {
            if let Some(signal) = self.interrupt.signal() {
                bail!("ended by signal {signal}");
            }
            self.policy.act(self.parameters, &observation, &mut action);
            let step = self.stage.step(&action)?;
            observation.clone_from(&step.s_next);
            trajectory.observations.push(step.s_next);
            trajectory.actions.push(action.clone());
            trajectory.rewards.push(step.reward);
            if step.terminated || step.truncated {
                trajectory.terminated = step.terminated;
                return Ok(trajectory);
            }
        }
    }
}

impl Stage {
    fn of(config: &Config) -> anyhow::Result<Self> {
        if !config.environment.server.is_empty() {
            return Ok(Self::Elsewhere(None));
        }
        let (name, parameters) = (&config.environment.name, &config.environment.parameters);
        let environment = VectorEnvironment::new(name, parameters, 1, config.run.seed, 0, 0)?;
        // Here no state is saved, and runs of older builds do not know its width.
        let said = EnvironmentSpec {
            state_width: config.spec.state_width,
            ..environment.spec().clone()
        };
        same_spec(config, &said)?;
        Ok(Self::Here(Box::new(environment)))
    }

    /// Whether a program has run part of an episode and may do better when it is started anew; the old one is ended.
    fn may_be_started_anew(&mut self) -> bool {
        match self {
            Self::Here(_) => false,
            Self::Elsewhere(conversation) => conversation
                .take()
                .is_some_and(|(_, conversation)| !conversation.is_silent()),
        }
    }

    /// Begins an episode; its first observation.
    fn begin(&mut self, config: &Config, start: Start<'_>, interrupt: &Interrupt) -> anyhow::Result<Vec<f32>> {
        match (self, start) {
            (Self::Here(environment), start) => {
                let mut observation = vec![0.0; config.spec.observation.width()];
                environment.reset(start, &mut observation)?;
                Ok(observation)
            }
            (Self::Elsewhere(conversation), Start::Evaluation { seed, first, .. }) => {
                if conversation.as_ref().is_none_or(|(of, _)| *of != seed) {
                    // One at a time.
                    *conversation = None;
                }
                let begin = || {
                    let begun = ExternalEnvironment::begin_unless(&config.environment, 1, seed, interrupt.clone())?;
                    same_spec(config, begun.spec())?;
                    anyhow::Ok((seed, Box::new(begun)))
                };
                let (_, conversation) = match conversation {
                    Some(begun) => begun,
                    None => conversation.insert(begin()?),
                };
                Ok(conversation.begin_evaluation(first)?.observation(0).to_vec())
            }
            (Self::Elsewhere(_), _) => bail!(
                "episodes of {} cannot be begun in a state of one's choice",
                config.environment.name
            ),
        }
    }

    fn step(&mut self, action: &[f32]) -> anyhow::Result<RolloutStep> {
        match self {
            Self::Here(environment) => {
                let width = environment.spec().observation.width();
                // What comes after an end is not looked at.
                let (mut observation, mut s_next) = (vec![0.0; width], vec![0.0; width]);
                let (mut reward, mut terminated, mut truncated) = ([0.0], [0.0], [0.0]);
                let blocks = StepBlocks {
                    observations: &mut observation,
                    next_observations: &mut s_next,
                    rewards: &mut reward,
                    terminated: &mut terminated,
                    truncated: &mut truncated,
                };
                environment.step(action, blocks)?;
                Ok(RolloutStep {
                    s_next,
                    reward: reward[0].into(),
                    terminated: terminated[0] != 0.0,
                    truncated: truncated[0] != 0.0,
                })
            }
            Self::Elsewhere(conversation) => {
                let (_, conversation) = conversation.as_mut().context("a step before an episode")?;
                let observed = conversation.step(action)?;
                Ok(RolloutStep {
                    s_next: observed.next_observation(0).to_vec(),
                    reward: observed.reward(0).into(),
                    terminated: observed.terminated(0),
                    truncated: observed.truncated(0),
                })
            }
        }
    }
}

fn same_spec(config: &Config, said: &EnvironmentSpec) -> anyhow::Result<()> {
    let name = &config.environment.name;
    ensure!(
        said.is(&config.spec),
        "config.toml: [spec] is not what environment {name} says of itself"
    );
    Ok(())
}

/// What a policy file of this run must hold.
pub fn policy_layout(config: &Config) -> anyhow::Result<PolicyLayout> {
    config
        .algorithm
        .policy_layout(&config.spec)
        .with_context(|| config.environment.name.clone())
}

fn policy_of(config: &Config) -> anyhow::Result<Policy> {
    config
        .algorithm
        .policy(&config.spec, 1)
        .with_context(|| config.environment.name.clone())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small;

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
