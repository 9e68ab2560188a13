//! The identity of runs from before its format had a number: at that time it was the `{:?}` output of parts of the
//! configuration. It is written field by field here, so that a change of a type cannot change it.

use toml::{Table, Value};

use super::sorted;
use crate::algorithms::{
    AlgorithmConfig, DdpgConfig, ExplorationConfig, ReinforceConfig, ReturnWeighting, TabularConfig, Warmup,
};
use crate::config::{Config, Mode, ObservationConfig, RewardConfig};
use shoal_policy::network::Activation;

/// The text; `None` for an algorithm, a network or rows that did not exist then.
pub(super) fn text(config: &Config) -> Option<String> {
    let Config { run, environment, .. } = config;
    let is_plain = config.observation == ObservationConfig::default() && config.reward == RewardConfig::default();
    if config.replay.n_step != 1 || !is_plain {
        return None;
    }
    let mode = match run.mode {
        Mode::Free => "Free",
        Mode::Lockstep => "Lockstep",
    };
    let algorithm = match &config.algorithm {
        AlgorithmConfig::Ddpg(settings) => ddpg(settings)?,
        AlgorithmConfig::Reinforce(settings) => reinforce(settings)?,
        AlgorithmConfig::QLearning(settings) => format!("QLearning({})", tabular(settings)),
        AlgorithmConfig::Sarsa(settings) => format!("Sarsa({})", tabular(settings)),
        // Later algorithms have no legacy text.
        _ => return None,
    };
    Some(format!(
        "{} {} {mode} {} {} {algorithm}",
        run.id,
        run.seed,
        environment.name,
        table(&environment.parameters)
    ))
}

fn ddpg(settings: &DdpgConfig) -> Option<String> {
    let DdpgConfig {
        hidden,
        activation,
        gamma,
        tau,
        actor_learning_rate,
        critic_learning_rate,
        batch,
        exploration: ExplorationConfig { theta, sigma, warmup },
        ..
    } = settings;
    let (&[h1, h2], Activation::Relu) = (&**hidden, activation) else {
        return None;
    };
    let warmup = match warmup {
        Warmup::Policy => "Policy",
        Warmup::Uniform => "Uniform",
    };
    Some(format!(
        "Ddpg {{ hidden: [{h1}, {h2}], gamma: {gamma:?}, tau: {tau:?}, actor_learning_rate: {actor_learning_rate:?}, \
         critic_learning_rate: {critic_learning_rate:?}, batch: {batch} }} \
         Exploration {{ theta: {theta:?}, sigma: {sigma:?}, warmup: {warmup} }}"
    ))
}

fn reinforce(settings: &ReinforceConfig) -> Option<String> {
    let ReinforceConfig {
        hidden,
        activation,
        gamma,
        learning_rate,
        weight,
        discount_steps,
        learn_at_limit,
        baseline_hidden,
        baseline_learning_rate,
        ..
    } = settings;
    let (&[h1, h2], &[b1, b2], Activation::Relu) = (&**hidden, &**baseline_hidden, activation) else {
        return None;
    };
    let weight = match weight {
        ReturnWeighting::Return => "Return",
        ReturnWeighting::Normalised => "Normalised",
        ReturnWeighting::Baseline => "Baseline",
    };
    Some(format!(
        "Reinforce(Reinforce {{ hidden: [{h1}, {h2}], gamma: {gamma:?}, learning_rate: {learning_rate:?}, \
         weight: {weight}, discount_steps: {discount_steps}, learn_at_limit: {learn_at_limit}, \
         baseline_hidden: [{b1}, {b2}], baseline_learning_rate: {baseline_learning_rate:?} }})"
    ))
}

fn tabular(settings: &TabularConfig) -> String {
    let TabularConfig {
        gamma, alpha, epsilon, ..
    } = settings;
    format!("Tabular {{ gamma: {gamma:?}, alpha: {alpha:?}, epsilon: {epsilon:?} }}")
}

fn table(table: &Table) -> String {
    let entry = |(name, value): (&String, &Value)| format!("{name:?}: {}", self::value(value));
    let entries: Vec<_> = sorted(table).into_iter().map(entry).collect();
    format!("{{{}}}", entries.join(", "))
}

fn value(value: &Value) -> String {
    match value {
        Value::String(text) => format!("String({text:?})"),
        Value::Integer(number) => format!("Integer({number})"),
        Value::Float(number) => format!("Float({number:?})"),
        Value::Boolean(truth) => format!("Boolean({truth})"),
        // No environment of that time had a parameter of these types.
        Value::Datetime(time) => format!("Datetime({time:?})"),
        Value::Array(values) => {
            let values: Vec<_> = values.iter().map(self::value).collect();
            format!("Array([{}])", values.join(", "))
        }
        Value::Table(entries) => format!("Table({})", table(entries)),
    }
}
