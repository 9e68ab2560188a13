//! How an algorithm's actors act: its policy, and what they do to try what the policy would not.

use shoal_policy::network::PolicyNetwork;
use shoal_policy::{Policy, Scores};

use super::exploration::ExplorationConfig;

/// A policy with the exploration around it. Which kind of policy goes with which exploration is said by the variants, so that
/// no other pair can be made.
#[derive(Clone, Debug)]
pub enum Behaviour {
    /// The policy says the action, and actors add noise to it.
    Noise(PolicyNetwork, ExplorationConfig),
    /// An action drawn with the probabilities that the policy says.
    Sample(Scores),
    /// The action with the highest score, but with this probability any of all.
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
