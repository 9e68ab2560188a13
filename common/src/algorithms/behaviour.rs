//! How an algorithm's actors act: its policy and their exploration.

use shoal_policy::network::{DeterministicPolicy, GaussianPolicy};
use shoal_policy::{Policy, Scores};

use super::exploration::ExplorationConfig;

/// A policy with its exploration. Each variant is a valid combination, so an invalid one cannot be made.
#[derive(Clone, Debug)]
pub enum Behaviour {
    /// The action of the policy, to which actors add noise.
    Noise(DeterministicPolicy, ExplorationConfig),
    /// An action drawn from the policy's distribution; uniformly from its range before the first update.
    Gaussian(GaussianPolicy),
    /// An action drawn from the policy's probabilities.
    Softmax(Scores),
    /// The action with the highest score, or with this probability an action drawn uniformly from all.
    EpsilonGreedy(Scores, Epsilon),
}

/// ε, the probability of a random action. It falls linearly.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Epsilon {
    /// Its first value.
    pub start: f64,
    /// Its last value.
    pub end: f64,
    /// Environment steps of all actors until it has its last value.
    pub steps: u64,
}

impl Epsilon {
    /// An ε that does not change.
    pub fn constant(epsilon: f64) -> Self {
        Self {
            start: epsilon,
            end: epsilon,
            steps: 0,
        }
    }

    /// Its value after this number of environment steps of all actors.
    pub fn after(&self, env_steps: u64) -> f64 {
        if env_steps >= self.steps {
            return self.end;
        }
        self.start + (self.end - self.start) * (env_steps as f64 / self.steps as f64)
    }
}

impl Behaviour {
    /// The same behaviour, whose policy normalises its observations or not. A table has no observations that could be
    /// normalised.
    pub fn normalising(self, normalised: bool) -> Self {
        match self {
            Self::Noise(policy, noise) => Self::Noise(policy.normalising(normalised), noise),
            Self::Gaussian(policy) => Self::Gaussian(policy.normalising(normalised)),
            Self::Softmax(scores) => Self::Softmax(scores.normalising(normalised)),
            Self::EpsilonGreedy(scores, epsilon) => Self::EpsilonGreedy(scores.normalising(normalised), epsilon),
        }
    }

    /// Numbers of exploration state that one environment keeps from step to step; 0 if the steps are independent.
    pub fn state_width(&self) -> usize {
        match self {
            Self::Noise(policy, _) => policy.range().width(),
            Self::Gaussian(_) | Self::Softmax(_) | Self::EpsilonGreedy(..) => 0,
        }
    }

    /// The policy without exploration.
    pub fn into_policy(self) -> Policy {
        match self {
            Self::Noise(policy, _) => Policy::Deterministic(policy),
            Self::Gaussian(policy) => Policy::Gaussian(policy),
            Self::Softmax(scores) | Self::EpsilonGreedy(scores, _) => Policy::Scored(scores),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn epsilon_falls_linearly_and_then_stays() {
        let epsilon = Epsilon {
            start: 1.0,
            end: 0.2,
            steps: 100,
        };
        let values = [0, 25, 50, 100, 1_000_000].map(|steps| epsilon.after(steps));
        for (value, expected) in values.into_iter().zip([1.0, 0.8, 0.6, 0.2, 0.2]) {
            assert!((value - expected).abs() < 1e-12, "{value} instead of {expected}");
        }
        assert_eq!([0, 7].map(|steps| Epsilon::constant(0.4).after(steps)), [0.4, 0.4]);
    }
}
