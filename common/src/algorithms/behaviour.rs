//! How an algorithm's actors act: its policy and their exploration.

use shoal_policy::network::PolicyNetwork;
use shoal_policy::{Policy, Scores};

use super::exploration::ExplorationConfig;

/// A policy with its exploration. Each variant is one valid combination, so no other can be made.
#[derive(Clone, Debug)]
pub enum Behaviour {
    /// The action of the policy, to which actors add noise.
    Noise(PolicyNetwork, ExplorationConfig),
    /// An action drawn from the policy's probabilities.
    Sample(Scores),
    /// The action with the highest score, or with this probability an action drawn uniformly from all.
    EpsilonGreedy(Scores, f64),
}

impl Behaviour {
    /// The policy without exploration.
    pub fn into_policy(self) -> Policy {
        match self {
            Self::Noise(network, _) => Policy::Deterministic(network),
            Self::Sample(scores) | Self::EpsilonGreedy(scores, _) => Policy::Scored(scores),
        }
    }
}
