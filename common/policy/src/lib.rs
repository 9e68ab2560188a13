//! The kinds of policy, as everyone evaluates them who acts: from a flat slice of parameters, in place.

pub mod network;
pub mod policy_file;
mod scores;

pub use scores::Scores;
use shoal_base::space::{EnvironmentSpec, Space};

use crate::network::{ActionRange, ActionRangeError, Hidden, NetworkLayout, PolicyNetwork};

/// What a policy's parameters are: what every process of a run must agree on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolicyLayout {
    /// A network whose tanh outputs are the action: DDPG's μ.
    Deterministic(NetworkLayout),
    /// A network whose outputs, after softmax, are the actions' probabilities: REINFORCE's π.
    Softmax(NetworkLayout),
    /// Action-values Q(s, a), state after state.
    Table {
        /// How many states there are.
        states: usize,
        /// How many actions.
        actions: usize,
    },
}

/// Why an algorithm cannot control an environment.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PolicyError {
    /// DDPG needs real-valued actions.
    #[error(transparent)]
    Action(#[from] ActionRangeError),
    /// A stochastic policy or a table needs actions that can be counted.
    #[error("{algorithm} needs a discrete action space, and these actions are real-valued (a box)")]
    CountedActions {
        /// Which algorithm.
        algorithm: &'static str,
    },
    /// A table needs states that can be counted.
    #[error("{algorithm} needs a discrete observation space, and these observations are real-valued (a box)")]
    CountedStates {
        /// Which algorithm.
        algorithm: &'static str,
    },
    /// A network would read an index as a quantity.
    #[error("{algorithm} needs real-valued observations (a box), and these are indices of {n} states")]
    RealStates {
        /// Which algorithm.
        algorithm: &'static str,
        /// How many states there are.
        n: u32,
    },
}

impl PolicyLayout {
    /// How many parameters there are.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Deterministic(network) | Self::Softmax(network) => network.parameters(),
            Self::Table { states, actions } => states * actions,
        }
    }

    /// A number that two layouts share only if they read parameters alike.
    pub fn fingerprint(&self) -> u64 {
        match self {
            Self::Deterministic(network) => network.fingerprint(),
            Self::Softmax(network) => !network.fingerprint(),
            Self::Table { states, actions } => ((*states as u64) << 32) | *actions as u64,
        }
    }
}

/// A policy with room for a batch of observations, without exploration. Its parameters are not its own: each call
/// borrows them.
#[derive(Clone, Debug)]
pub enum Policy {
    /// Says the action.
    Deterministic(PolicyNetwork),
    /// Says a score for every action, and takes the highest: π(a|s) or Q(s, a).
    Scored(Scores),
}

impl Policy {
    /// What its parameters are.
    pub fn layout(&self) -> PolicyLayout {
        match self {
            Self::Deterministic(network) => PolicyLayout::Deterministic(*network.layout()),
            Self::Scored(scores) => scores.layout(),
        }
    }

    /// Writes the policy's action for every observation, one after the other, into `actions`. Of actions with the same
    /// score the first is taken.
    ///
    /// Panics when the slices do not fit the layout, or hold more than the batch. Nothing is allocated.
    pub fn act(&mut self, parameters: &[f32], observations: &[f32], actions: &mut [f32]) {
        match self {
            Self::Deterministic(network) => network.forward(parameters, observations, actions),
            Self::Scored(scores) => {
                let of_each = scores.of(parameters, observations);
                for (action, scores) in actions.iter_mut().zip(of_each) {
                    *action = highest(scores) as f32;
                }
            }
        }
    }
}

/// A deterministic policy with these hidden layers in an environment like `spec`, for at most `batch` observations a call.
///
/// # Errors
/// When the actions are no real numbers in finite ranges.
pub fn deterministic(hidden: Hidden, spec: &EnvironmentSpec, batch: usize) -> Result<PolicyNetwork, PolicyError> {
    let range = ActionRange::new(&spec.action)?;
    Ok(PolicyNetwork::new(spec.observation.width(), hidden, range, batch))
}

/// A softmax policy with these hidden layers in an environment like `spec`, for at most `batch` observations a call;
/// `algorithm` is named where it does not fit.
///
/// # Errors
/// When the actions cannot be counted, or the observations are no real numbers.
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

/// A table of action-values in an environment like `spec`, for at most `batch` observations a call; `algorithm` is named where
/// it does not fit.
///
/// # Errors
/// When states or actions cannot be counted.
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

/// The index of the highest score, the first of equals. What is not a number is no score.
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
    fn a_table_is_read_state_after_state_and_the_first_of_equals_taken() {
        let lake = spec(Space::discrete(3), Space::discrete(2));
        let mut policy = Policy::Scored(table("q-learning", &lake, 4).unwrap());
        assert_eq!(policy.layout().parameters(), 6);
        let mut actions = [f32::NAN; 4];
        policy.act(&[0.0, 1.0, 0.5, 0.5, 2.0, 1.0], &[0.0, 1.0, 2.0, 0.0], &mut actions);
        assert_eq!(actions, [1.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn parameters_of_one_kind_are_not_taken_for_another() {
        let network = NetworkLayout::policy(4, Hidden::relu([10, 2]), 2);
        let (deterministic, softmax) = (PolicyLayout::Deterministic(network), PolicyLayout::Softmax(network));
        assert_ne!(deterministic.fingerprint(), softmax.fingerprint());
        assert_eq!(
            deterministic.fingerprint(),
            network.fingerprint(),
            "of files that are there"
        );
        let table = |states, actions| PolicyLayout::Table { states, actions }.fingerprint();
        assert_ne!(table(16, 4), table(4, 16));
    }
}
