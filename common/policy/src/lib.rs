//! The kinds of policy. Actors and evaluator compute actions from a flat slice of parameters, in place.

pub mod network;
pub mod policy_file;
mod scores;

pub use scores::Scores;
use shoal_base::space::{EnvironmentSpec, Space};

use crate::network::{ActionRange, ActionRangeError, Hidden, NetworkLayout, PolicyNetwork};

/// The layout of a policy's parameters, which all processes of a run must agree on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolicyLayout {
    /// A network whose tanh outputs are the action: DDPG's μ.
    Deterministic(NetworkLayout),
    /// A network whose outputs, after softmax, are the actions' probabilities: REINFORCE's π.
    Softmax(NetworkLayout),
    /// A table of action-values Q(s, a), state after state.
    Table {
        /// Number of states.
        states: usize,
        /// Number of actions.
        actions: usize,
    },
}

/// Why an algorithm cannot control an environment.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PolicyError {
    /// DDPG needs real-valued actions.
    #[error(transparent)]
    Action(#[from] ActionRangeError),
    /// A softmax policy or a table needs discrete actions.
    #[error("{algorithm} needs a discrete action space, but these actions are real-valued (a box)")]
    CountedActions {
        /// The algorithm.
        algorithm: &'static str,
    },
    /// A table needs discrete observations.
    #[error("{algorithm} needs a discrete observation space, but these observations are real-valued (a box)")]
    CountedStates {
        /// The algorithm.
        algorithm: &'static str,
    },
    /// A network needs real-valued observations: it would use an index as a quantity.
    #[error("{algorithm} needs real-valued observations (a box), but these are indices of {n} states")]
    RealStates {
        /// The algorithm.
        algorithm: &'static str,
        /// Number of states.
        n: u32,
    },
}

impl PolicyLayout {
    /// The number of parameters.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Deterministic(network) | Self::Softmax(network) => network.parameters(),
            Self::Table { states, actions } => states * actions,
        }
    }

    /// The fingerprint: two layouts have the same one only if they read parameters alike.
    pub fn fingerprint(&self) -> u64 {
        match self {
            Self::Deterministic(network) => network.fingerprint(),
            Self::Softmax(network) => !network.fingerprint(),
            Self::Table { states, actions } => ((*states as u64) << 32) | *actions as u64,
        }
    }
}

/// A policy without exploration, with buffers for a batch of observations. It does not own its parameters: each call
/// borrows them.
#[derive(Clone, Debug)]
pub enum Policy {
    /// A network whose output is the action.
    Deterministic(PolicyNetwork),
    /// A score for every action, π(a|s) or Q(s, a). The action with the highest score is taken.
    Scored(Scores),
}

impl Policy {
    /// The layout of its parameters.
    pub fn layout(&self) -> PolicyLayout {
        match self {
            Self::Deterministic(network) => PolicyLayout::Deterministic(*network.layout()),
            Self::Scored(scores) => scores.layout(),
        }
    }

    /// Writes the policy's action for every observation, one after the other, into `actions`. If several actions have
    /// the highest score, the first is taken. Nothing is allocated.
    ///
    /// # Panics
    /// If the slices do not match the layout, or have more observations than the batch.
    pub fn act(&mut self, parameters: &[f32], observations: &[f32], actions: &mut [f32]) {
        match self {
            Self::Deterministic(network) => network.forward(parameters, observations, actions),
            Self::Scored(scores) => {
                let all_scores = scores.of(parameters, observations);
                for (action, scores) in actions.iter_mut().zip(all_scores) {
                    *action = highest(scores) as f32;
                }
            }
        }
    }
}

/// A deterministic policy with these hidden layers in an environment like `spec`, for at most `batch` observations a
/// call.
///
/// # Errors
/// When the actions are not real numbers in finite ranges.
pub fn deterministic(hidden: Hidden, spec: &EnvironmentSpec, batch: usize) -> Result<PolicyNetwork, PolicyError> {
    let range = ActionRange::new(&spec.action)?;
    Ok(PolicyNetwork::new(spec.observation.width(), hidden, range, batch))
}

/// A softmax policy with these hidden layers in an environment like `spec`, for at most `batch` observations a call.
/// `algorithm` is named in errors.
///
/// # Errors
/// When the actions are not discrete, or the observations are not real numbers.
pub fn softmax(
    algorithm: &'static str,
    hidden: Hidden,
    spec: &EnvironmentSpec,
    batch: usize,
) -> Result<Scores, PolicyError> {
    let actions = counted_actions(algorithm, spec)?;
    match spec.observation {
        Space::Discrete { n, .. } => Err(PolicyError::RealStates { algorithm, n }),
        Space::Box { .. } => {
            let network = NetworkLayout::policy(spec.observation.width(), hidden, actions);
            Ok(Scores::softmax(network, batch))
        }
    }
}

/// A table of action-values in an environment like `spec`, for at most `batch` observations a call. `algorithm` is
/// named in errors.
///
/// # Errors
/// When observations or actions are not discrete.
pub fn table(algorithm: &'static str, spec: &EnvironmentSpec, batch: usize) -> Result<Scores, PolicyError> {
    let actions = counted_actions(algorithm, spec)?;
    match spec.observation {
        Space::Discrete { n, .. } => Ok(Scores::table(n as usize, actions, batch)),
        Space::Box { .. } => Err(PolicyError::CountedStates { algorithm }),
    }
}

fn counted_actions(algorithm: &'static str, spec: &EnvironmentSpec) -> Result<usize, PolicyError> {
    match spec.action {
        Space::Discrete { n, .. } => Ok(n as usize),
        Space::Box { .. } => Err(PolicyError::CountedActions { algorithm }),
    }
}

/// The index of the highest score; the first one of equal scores. A NaN is never higher than another score.
pub fn highest(scores: &[f32]) -> usize {
    let mut best = 0;
    for (index, score) in scores.iter().enumerate() {
        if *score > scores[best] {
            best = index;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(observation: Space, action: Space) -> EnvironmentSpec {
        EnvironmentSpec {
            observation,
            action,
            time_limit: 100,
            state_width: 0,
        }
    }

    #[test]
    fn a_table_is_read_state_after_state_and_the_first_of_equal_actions_is_taken() {
        let lake = spec(Space::discrete(3), Space::discrete(2));
        let mut policy = Policy::Scored(table("q-learning", &lake, 4).unwrap());
        assert_eq!(policy.layout().parameters(), 6);
        let mut actions = [f32::NAN; 4];
        policy.act(&[0.0, 1.0, 0.5, 0.5, 2.0, 1.0], &[0.0, 1.0, 2.0, 0.0], &mut actions);
        assert_eq!(actions, [1.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn different_kinds_of_policies_have_different_fingerprints() {
        let network = NetworkLayout::policy(4, Hidden::relu([10, 2]), 2);
        let (deterministic, softmax) = (PolicyLayout::Deterministic(network), PolicyLayout::Softmax(network));
        assert_ne!(deterministic.fingerprint(), softmax.fingerprint());
        assert_eq!(
            deterministic.fingerprint(),
            network.fingerprint(),
            "as in existing files"
        );
        let table = |states, actions| PolicyLayout::Table { states, actions }.fingerprint();
        assert_ne!(table(16, 4), table(4, 16));
    }
}
