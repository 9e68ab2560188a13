//! Whole episodes of a policy without exploration, for `eval`, `plot`, `report` and `film`. Built-in environments run in this
//! process, others in their servers.

use anyhow::{Context, bail, ensure};
use shoal_common::channel::environment::StepBlocks;
use shoal_common::config::Config;
use shoal_common::policy::{Policy, PolicyLayout};
use shoal_common::run_dir::RunDir;
use shoal_common::space::EnvironmentSpec;
use shoal_env_server::environment::SignalSource;
use shoal_env_server::environment::angle::unwrapped;
use shoal_env_server::frame::{Frame, Written};
use shoal_env_server::vector::{Reset, VectorEnvironment};

use crate::evaluation::frames::{FrameCollector, Frames};
use crate::external_environment::ExternalEnvironment;
use crate::external_environment::server_location::LaunchContext;
use crate::signals::{Interrupt, describe};

/// How many times an episode is tried if the environment's server fails, each time with a new server.
const TRIES: u32 = 5;

/// An episode of T steps.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    /// T + 1 observations, including the one after the last step.
    pub observations: Vec<Vec<f32>>,
    /// T actions, in the environment's units.
    pub actions: Vec<Vec<f32>>,
    /// T rewards.
    pub rewards: Vec<f64>,
    /// Whether the last state is terminal. Otherwise the time limit ended the episode.
    pub terminated: bool,
}

impl Trajectory {
    /// The undiscounted sum of the rewards.
    pub fn episode_return(&self) -> f64 {
        self.rewards.iter().sum()
    }

    /// A signal's values: T + 1 for a part of the observation, T for a part of the action. A number that does not exist
    /// is NaN.
    pub fn values(&self, source: SignalSource) -> Vec<f64> {
        let number = |row: &Vec<f32>, i: usize| row.get(i).map_or(f64::NAN, |number| f64::from(*number));
        match source {
            SignalSource::Observation(i) => self.observations.iter().map(|row| number(row, i)).collect(),
            SignalSource::Action(i) => self.actions.iter().map(|row| number(row, i)).collect(),
            SignalSource::Angle { cos, sin } => {
                let seen = self
                    .observations
                    .iter()
                    .map(|row| number(row, sin).atan2(number(row, cos)));
                let first = seen.clone().next().unwrap_or_default();
                unwrapped(seen, first)
            }
        }
    }
}

/// A policy and a single environment to run it in.
pub struct Rollout<'a> {
    config: &'a Config,
    environment: RolloutEnvironment,
    policy: Policy,
    parameters: &'a [f32],
    launch_context: LaunchContext,
    interrupt: Interrupt,
}

/// Where the environment runs.
enum RolloutEnvironment {
    /// In this process.
    Builtin(Box<VectorEnvironment>),
    /// In another program, which is started with the first episode. The number is the seed of its evaluation episodes.
    External(Option<(u64, Box<ExternalEnvironment>)>),
}

/// The result of a step.
struct RolloutStep {
    s_next: Vec<f32>,
    reward: f64,
    terminated: bool,
    truncated: bool,
}

impl<'a> Rollout<'a> {
    /// Combines the environment and the network of `config` with these parameters.
    ///
    /// # Errors
    /// When the network has another number of parameters, or the environment differs from the configuration.
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
            environment: RolloutEnvironment::new(config)?,
            policy,
            parameters,
            launch_context: LaunchContext::default(),
            interrupt: Interrupt::default(),
        })
    }

    /// As [`new`](Self::new), for a run: an environment that another program serves is started as in training.
    pub fn of_run(run: &RunDir, config: &'a Config, parameters: &'a [f32]) -> anyhow::Result<Self> {
        Ok(Self {
            launch_context: LaunchContext::of_run(run, config)?,
            ..Self::new(config, parameters)?
        })
    }

    /// After a signal, episodes end with an error.
    pub fn interruptible_by(self, interrupt: Interrupt) -> Self {
        Self { interrupt, ..self }
    }

    /// Asks an environment that another program serves for pictures, at most this many pixels high.
    pub fn with_pictures(mut self, height: u32) -> Self {
        self.launch_context.picture_height = Some(height);
        self
    }

    /// Runs evaluation episode `number` of `seed`. The two determine its start state.
    pub fn evaluation_episode(&mut self, seed: u64, number: u64) -> anyhow::Result<Trajectory> {
        self.episode(evaluation(seed, number), &mut |_| (), None)
            .map(|(trajectory, _)| trajectory)
    }

    /// As [`evaluation_episode`](Self::evaluation_episode), with pictures, about `max_frames` at most, or the reason
    /// why there are none: a sentence without its full stop. A long episode is played twice, because drawing takes much
    /// longer than stepping: first for its length, then to draw evenly spaced states. Where another program serves the
    /// environment, call [`with_pictures`](Self::with_pictures) first. Calls `progress` with the number of steps.
    pub fn filmed_episode(
        &mut self,
        (seed, number): (u64, u64),
        max_frames: usize,
        mut progress: impl FnMut(usize),
    ) -> anyhow::Result<(Trajectory, Result<Frames, String>)> {
        let mut stride = 1;
        if self.config.spec.time_limit as usize >= max_frames {
            let (played, _) = self.episode(evaluation(seed, number), &mut |_| (), None)?;
            stride = played.actions.len().div_ceil(max_frames.max(2) - 1);
        }
        self.episode(evaluation(seed, number), &mut progress, Some((max_frames, stride)))
    }

    /// Runs an episode that starts in this physical state of the environment, which must be a built-in one.
    pub fn episode_from(&mut self, state: &[f64]) -> anyhow::Result<Trajectory> {
        self.episode(Reset::States(state), &mut |_| (), None)
            .map(|(trajectory, _)| trajectory)
    }

    /// Runs an episode. If the environment's server fails in it, it is run again with a new server.
    fn episode(
        &mut self,
        reset: Reset<'_>,
        progress: &mut dyn FnMut(usize),
        frames: Option<(usize, usize)>,
    ) -> anyhow::Result<(Trajectory, Result<Frames, String>)> {
        let mut tries = 1;
        loop {
            let mut collector = frames.map(|(max_frames, stride)| FrameCollector::new(max_frames, stride));
            match self.try_episode(reset, progress, &mut collector) {
                Err(_) if tries < TRIES && self.interrupt.signal().is_none() && self.environment.can_be_restarted() => {
                    tries += 1;
                }
                Err(error) if tries > 1 => bail!("{error:#} (the episode was begun {tries} times)"),
                Err(error) => return Err(error),
                Ok(trajectory) => {
                    let nothing = || Err("no pictures were asked for".into());
                    return Ok((trajectory, collector.map_or_else(nothing, FrameCollector::finish)));
                }
            }
        }
    }

    fn try_episode(
        &mut self,
        reset: Reset<'_>,
        progress: &mut dyn FnMut(usize),
        collector: &mut Option<FrameCollector>,
    ) -> anyhow::Result<Trajectory> {
        self.environment.ask_for_picture()?;
        let mut observation = self
            .environment
            .begin(self.config, &self.launch_context, reset, &self.interrupt)?;
        let mut action = vec![0.0; self.config.spec.action.width()];
        let mut trajectory = Trajectory {
            observations: vec![observation.clone()],
            ..Trajectory::default()
        };
        for steps in 0.. {
            if let Some(signal) = self.interrupt.signal() {
                bail!("ended by {}", describe(signal));
            }
            progress(steps);
            self.policy.act(self.parameters, &observation, &mut action);
            if let Some(collector) = collector.as_mut().filter(|collector| collector.wants(steps)) {
                collector.add(self.environment.see(&action)?);
            }
            let last = steps + 1 == self.config.spec.time_limit as usize;
            let wants_next = collector.as_ref().is_some_and(|it| last || it.wants(steps + 1));
            if wants_next {
                self.environment.ask_for_picture()?;
            }
            let step = self.environment.step(&action)?;
            observation.clone_from(&step.s_next);
            trajectory.observations.push(step.s_next);
            trajectory.actions.push(action.clone());
            trajectory.rewards.push(step.reward);
            if step.terminated || step.truncated {
                if let (Some(collector), true) = (collector, wants_next || self.environment.is_builtin()) {
                    collector.add_last(self.environment.see(&[])?.and_then(|written| written.frame.ok()));
                }
                trajectory.terminated = step.terminated;
                break;
            }
        }
        Ok(trajectory)
    }
}

/// The start of evaluation episode `number`.
fn evaluation(seed: u64, number: u64) -> Reset<'static> {
    Reset::Evaluation {
        seed,
        first: number,
        episodes: Some(1),
    }
}

impl RolloutEnvironment {
    fn new(config: &Config) -> anyhow::Result<Self> {
        if config.environment.is_external() {
            return Ok(Self::External(None));
        }
        let (name, parameters) = (&config.environment.name, &config.environment.parameters);
        let environment = VectorEnvironment::new(name, parameters, 1, config.run.seed, 0, 0)?;
        // No state is saved here, and the configurations of earlier versions lack its width.
        let found = EnvironmentSpec {
            state_width: config.spec.state_width,
            ..environment.spec().clone()
        };
        check_spec(config, &found)?;
        Ok(Self::Builtin(Box::new(environment)))
    }

    /// Ends the server that has failed in an episode. Returns whether a new one may do better.
    fn can_be_restarted(&mut self) -> bool {
        match self {
            Self::Builtin(_) => false,
            Self::External(server) => server.take().is_some_and(|(_, server)| !server.is_silent()),
        }
    }

    /// Begins an episode and returns its first observation.
    fn begin(
        &mut self,
        config: &Config,
        launch_context: &LaunchContext,
        reset: Reset<'_>,
        interrupt: &Interrupt,
    ) -> anyhow::Result<Vec<f32>> {
        match (self, reset) {
            (Self::Builtin(environment), reset) => {
                let mut observation = vec![0.0; config.spec.observation.width()];
                environment.reset(reset, &mut observation)?;
                Ok(observation)
            }
            (Self::External(server), Reset::Evaluation { seed, first, .. }) => {
                if server.as_ref().is_none_or(|(of, _)| *of != seed) {
                    // The old server ends before the new one starts.
                    *server = None;
                }
                let begin = || {
                    let (launch_context, interrupt) = (launch_context.clone(), interrupt.clone());
                    let begun = ExternalEnvironment::begin_in(&config.environment, 1, seed, launch_context, interrupt)?;
                    check_spec(config, begun.spec())?;
                    anyhow::Ok((seed, Box::new(begun)))
                };
                let (_, server) = match server {
                    Some(begun) => begun,
                    None => server.insert(begin()?),
                };
                Ok(server.begin_evaluation(first)?.observation(0).to_vec())
            }
            (Self::External(_), _) => bail!("episodes of {} cannot start in a chosen state", config.environment.name),
        }
    }

    fn is_builtin(&self) -> bool {
        matches!(self, Self::Builtin(_))
    }

    /// Asks for a picture of the state that the next begin or step leads to.
    fn ask_for_picture(&self) -> anyhow::Result<()> {
        match self {
            Self::External(Some((_, server))) => server.ask_for_picture(),
            Self::External(None) | Self::Builtin(_) => Ok(()),
        }
    }

    /// The picture of the current state, in which `action` will be taken; `None` if there is none. Another program
    /// writes the picture when it reaches the state, so it knows only the action before.
    fn see(&self, action: &[f32]) -> anyhow::Result<Option<Written>> {
        match self {
            Self::Builtin(environment) => {
                let drawing = environment.draw(action).map(Frame::Drawing);
                let frame = drawing.ok_or_else(|| "the environment does not draw itself".into());
                Ok(Some(Written { frame, fps: None }))
            }
            Self::External(Some((_, server))) => server.picture(),
            Self::External(None) => Ok(None),
        }
    }

    fn step(&mut self, action: &[f32]) -> anyhow::Result<RolloutStep> {
        match self {
            Self::Builtin(environment) => {
                let width = environment.spec().observation.width();
                // The first observation of the next episode is not used.
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
            Self::External(server) => {
                let (_, server) = server.as_mut().context("a step was taken before an episode began")?;
                let observed = server.step(action)?;
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

fn check_spec(config: &Config, found: &EnvironmentSpec) -> anyhow::Result<()> {
    let name = &config.environment.name;
    ensure!(
        found.difference(&config.spec).is_none(),
        "config.toml: [spec] does not match the environment {name}"
    );
    Ok(())
}

/// The layout that a policy file of this run must have.
pub fn policy_layout(config: &Config) -> anyhow::Result<PolicyLayout> {
    config.policy_layout().with_context(|| config.environment.name.clone())
}

fn policy_of(config: &Config) -> anyhow::Result<Policy> {
    config.policy(1).with_context(|| config.environment.name.clone())
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
            "it keeps hanging down"
        );
    }

    #[test]
    fn an_evaluation_episode_depends_only_on_seed_and_number() {
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
    fn a_wrong_number_of_parameters_and_a_diverged_policy_are_errors() {
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
