//! What each number of a configuration may be.

use std::fmt::Display;

use super::{Algorithm, Config, ConfigError, Ddpg, Exploration, Mode, Reinforce, Tabular};
use crate::policy::PolicyLayout;
use crate::space::Space;

/// Numbers in an observation or an action: many more than any environment has, and few enough that sizes computed from
/// them stay far from overflowing.
const WIDEST: usize = 4_096;

impl Config {
    /// Whether every number is one that makes sense.
    ///
    /// # Errors
    /// For the first that does not.
    pub fn check(&self) -> Result<(), ConfigError> {
        let Self {
            run,
            spec,
            actors,
            algorithm,
            learner,
            replay,
            evaluation,
            checkpoint,
            ..
        } = self;
        named("run.id", &run.id)?;
        within("run.seed", run.seed, 0, i64::MAX as u64)?;
        within("run.stall_seconds", run.stall_seconds, 1, 86_400)?;
        within("run.steps", run.steps, 1, 1_000_000_000_000)?;
        sized("spec.observation", &spec.observation)?;
        sized("spec.action", &spec.action)?;
        within("spec.time_limit", spec.time_limit, 1, 1_000_000)?;
        within("actors.max", actors.max, 1, 256)?;
        within("actors.count", actors.count, 1, actors.max)?;
        within("actors.envs", actors.envs, 1, 4_096)?;
        within("actors.chunk_steps", actors.chunk_steps, 1, 4_096)?;
        within("actors.window", actors.window, 1, 64)?;
        if let Some(episodes) = run.episodes {
            within("run.episodes", episodes, 1, 1_000_000_000)?;
        }
        within("replay.capacity", replay.capacity, 1, 1_000_000_000)?;
        match algorithm {
            Algorithm::Ddpg(ddpg, exploration) => {
                check_ddpg(ddpg, exploration)?;
                within("replay.capacity", replay.capacity, ddpg.batch as u64, 1_000_000_000)?;
                within("replay.warmup", replay.warmup, 1, replay.capacity)?;
                within("replay.updates_per_step", replay.updates_per_step, 0.0, 1_000.0)?;
            }
            Algorithm::Reinforce(reinforce) => check_reinforce(reinforce)?,
            Algorithm::QLearning(tabular) => {
                check_tabular(["q-learning.gamma", "q-learning.alpha", "q-learning.epsilon"], tabular)?
            }
            Algorithm::Sarsa(tabular) => check_tabular(["sarsa.gamma", "sarsa.alpha", "sarsa.epsilon"], tabular)?,
        }
        within("learner.threads", learner.threads, 1, 2)?;
        PolicyLayout::new(algorithm, spec).map_err(|cause| ConfigError::Control {
            algorithm: algorithm.name(),
            environment: self.environment.name.clone(),
            cause,
        })?;
        self.check_use_of_rows()?;
        within("replay.tolerance", replay.tolerance, 1, 1_000_000_000)?;
        within("evaluation.every", evaluation.every, 1, u64::MAX)?;
        within("evaluation.episodes", evaluation.episodes, 1, 10_000)?;
        within("evaluation.final_episodes", evaluation.final_episodes, 1, 100_000)?;
        within("checkpoint.every_seconds", checkpoint.every_seconds, 0.0, 86_400.0)?;
        within("checkpoint.every_updates", checkpoint.every_updates, 1, 1_000_000_000)
    }
}

impl Config {
    /// What an algorithm asks of the rows' way to it.
    fn check_use_of_rows(&self) -> Result<(), ConfigError> {
        let Self { algorithm, replay, .. } = self;
        let name = algorithm.name();
        let only = |key, value: String, only: &str, why: &str| ConfigError::OutOfRange {
            key,
            value,
            expected: format!("{only}: {name} {why}"),
        };
        if !algorithm.samples() {
            let why = "learns from each step once, from the first on";
            if replay.warmup != 0 {
                return Err(only("replay.warmup", replay.warmup.to_string(), "0", why));
            }
            if replay.updates_per_step != 1.0 {
                let value = replay.updates_per_step.to_string();
                return Err(only("replay.updates_per_step", value, "1", why));
            }
        }
        if !algorithm.is_off_policy() && self.run.mode == Mode::Free {
            let why = "learns from what the newest policy does and from nothing older";
            return Err(only("run.mode", "free".into(), "lockstep", why));
        }
        if algorithm.learns_from_episodes() {
            let why = "learns from whole episodes, each in a chunk of its own";
            let (limit, steps) = (self.spec.time_limit, self.actors.chunk_steps);
            if steps != limit {
                let limit = format!("{limit}, the time limit");
                return Err(only("actors.chunk_steps", steps.to_string(), &limit, why));
            }
            if self.actors.envs != 1 {
                return Err(only("actors.envs", self.actors.envs.to_string(), "1", why));
            }
        }
        Ok(())
    }
}

fn check_ddpg(ddpg: &Ddpg, exploration: &Exploration) -> Result<(), ConfigError> {
    within("exploration.theta", exploration.theta, 0.0, 1.0)?;
    within("exploration.sigma", exploration.sigma, 0.0, 10.0)?;
    within("ddpg.hidden[0]", ddpg.hidden[0], 1, 8_192)?;
    within("ddpg.hidden[1]", ddpg.hidden[1], 1, 8_192)?;
    within("ddpg.gamma", ddpg.gamma, 0.0, 1.0)?;
    within("ddpg.tau", ddpg.tau, 0.0, 1.0)?;
    within("ddpg.actor_learning_rate", ddpg.actor_learning_rate, 0.0, 1.0)?;
    within("ddpg.critic_learning_rate", ddpg.critic_learning_rate, 0.0, 1.0)?;
    within("ddpg.batch", ddpg.batch, 1, 65_536)
}

fn check_reinforce(reinforce: &Reinforce) -> Result<(), ConfigError> {
    let Reinforce {
        hidden,
        baseline_hidden,
        ..
    } = reinforce;
    within("reinforce.hidden[0]", hidden[0], 1, 8_192)?;
    within("reinforce.hidden[1]", hidden[1], 1, 8_192)?;
    within("reinforce.baseline_hidden[0]", baseline_hidden[0], 1, 8_192)?;
    within("reinforce.baseline_hidden[1]", baseline_hidden[1], 1, 8_192)?;
    within("reinforce.gamma", reinforce.gamma, 0.0, 1.0)?;
    within("reinforce.learning_rate", reinforce.learning_rate, 0.0, 1.0)?;
    within(
        "reinforce.baseline_learning_rate",
        reinforce.baseline_learning_rate,
        0.0,
        1.0,
    )
}

fn check_tabular([gamma, alpha, epsilon]: [&'static str; 3], tabular: &Tabular) -> Result<(), ConfigError> {
    within(gamma, tabular.gamma, 0.0, 1.0)?;
    within(alpha, tabular.alpha, 0.0, 1.0)?;
    within(epsilon, tabular.epsilon, 0.0, 1.0)
}

fn within<T: PartialOrd + Display>(key: &'static str, value: T, low: T, high: T) -> Result<(), ConfigError> {
    if low <= value && value <= high {
        return Ok(());
    }
    Err(ConfigError::OutOfRange {
        key,
        value: value.to_string(),
        expected: format!("from {low} to {high}"),
    })
}

/// The id is part of file names, and what has those names is removed when the run ends: `..` would be everybody's.
fn named(key: &'static str, id: &str) -> Result<(), ConfigError> {
    if (1..=32).contains(&id.len()) && id.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-') {
        return Ok(());
    }
    Err(ConfigError::OutOfRange {
        key,
        value: format!("{id:?}"),
        expected: "1 to 32 letters, digits and hyphens, as the program chose it".into(),
    })
}

fn sized(key: &'static str, space: &Space) -> Result<(), ConfigError> {
    let (value, expected) = match space {
        Space::Discrete { n: 0 } => ("no index at all".into(), "one index or more".into()),
        Space::Box { low, high } if low.len() != high.len() || !(1..=WIDEST).contains(&low.len()) => (
            format!("{} lower and {} upper bounds", low.len(), high.len()),
            format!("as many of each, from 1 to {WIDEST}"),
        ),
        _ => return Ok(()),
    };
    Err(ConfigError::OutOfRange { key, value, expected })
}
