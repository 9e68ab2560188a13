//! The kinds of policy. Actors and evaluator compute actions from a flat slice of parameters, in place.

pub mod network;
pub mod policy_file;
mod scores;

pub use scores::{Scores, combine_heads};
use shoal_base::space::{EnvironmentSpec, Space};

use crate::network::{ActionRange, ActionRangeError, DeterministicPolicy, GaussianPolicy, NetworkLayout};

/// The layout of a policy's parameters, which all processes of a run must agree on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PolicyLayout {
    /// A network whose tanh outputs are the action: μ of DDPG and TD3.
    Deterministic(NetworkLayout),
    /// A network whose outputs are the means and log standard deviations of a squashed normal distribution: SAC's π.
    Gaussian(NetworkLayout),
    /// A network whose outputs, after softmax, are the actions' probabilities: REINFORCE's π.
    Softmax(NetworkLayout),
    /// A network whose outputs are the action-values: DQN's Q.
    ActionValues(NetworkLayout),
    /// A network whose outputs are V(s) and the advantages of the actions: DQN's Q with dueling heads.
    Dueling(NetworkLayout),
    /// A table of action-values Q(s, a), state after state.
    Table {
        /// Number of states.
        states: usize,
        /// Number of actions.
        actions: usize,
    },
}

/// Why an algorithm cannot control an environment. The messages begin with "it", the algorithm.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PolicyError {
    /// A policy with tanh outputs needs real-valued actions.
    #[error(transparent)]
    Action(#[from] ActionRangeError),
    /// A score for every action needs discrete actions.
    #[error("it needs a discrete action space, but these actions are real-valued (a box)")]
    DiscreteActionsRequired,
    /// A table needs discrete observations.
    #[error("it needs a discrete observation space, but these observations are real-valued (a box)")]
    DiscreteObservationsRequired,
    /// A network needs real-valued observations: it would use an index as a quantity.
    #[error("it needs real-valued observations (a box), but these are indices of {n} states")]
    RealObservationsRequired {
        /// Number of states.
        n: u32,
    },
}

impl PolicyLayout {
    /// The number of parameters.
    pub fn parameters(&self) -> usize {
        match self {
            Self::Deterministic(network)
            | Self::Gaussian(network)
            | Self::Softmax(network)
            | Self::ActionValues(network)
            | Self::Dueling(network) => network.parameters(),
            Self::Table { states, actions } => states * actions,
        }
    }

    /// The fingerprint: two layouts have the same one only if they read parameters alike.
    pub fn fingerprint(&self) -> u64 {
        match self {
            Self::Deterministic(network) => network.fingerprint(),
            Self::Softmax(network) => !network.fingerprint(),
            Self::Gaussian(network) => network.fingerprint() ^ u64::from_le_bytes(*b"gaussian"),
            Self::ActionValues(network) => network.fingerprint() ^ u64::from_le_bytes(*b"q-values"),
            Self::Dueling(network) => network.fingerprint() ^ u64::from_le_bytes(*b"dueling "),
            Self::Table { states, actions } => ((*states as u64) << 32) | *actions as u64,
        }
    }
}

/// A policy without exploration, with buffers for a batch of observations. It does not own its parameters: each call
/// borrows them.
///
/// ```
/// use shoal_base::space::{EnvironmentSpec, Space};
/// use shoal_policy::network::{Hidden, NetworkLayout};
/// use shoal_policy::{Policy, deterministic};
///
/// # fn main() -> Result<(), shoal_policy::PolicyError> {
/// let spec = EnvironmentSpec {
///     observation: Space::boxed(&[(-1.0, 1.0); 3]),
///     action: Space::boxed(&[(-2.0, 2.0)]),
///     time_limit: 200,
///     state_width: 0,
/// };
/// let network = NetworkLayout::new(3, Hidden::relu([8]), 1);
/// let mut policy = Policy::Deterministic(deterministic(network, &spec, 2)?);
///
/// let mut parameters = vec![0.0; policy.layout().parameters()];
/// let observations = [0.1, 0.2, 0.3, -0.1, -0.2, -0.3]; // two of them
/// let mut actions = [f32::NAN; 2];
/// policy.act(&parameters, &observations, &mut actions);
/// assert_eq!(actions, [0.0, 0.0]); // the middle of the range
///
/// // The last parameter is the bias of the output: tanh 100 is 1, the upper end of the range.
/// let last = parameters.len() - 1;
/// parameters[last] = 100.0;
/// policy.act(&parameters, &observations, &mut actions);
/// assert_eq!(actions, [2.0, 2.0]);
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
pub enum Policy {
    /// A network whose output is the action.
    Deterministic(DeterministicPolicy),
    /// A squashed normal distribution. The action of its mean is taken.
    Gaussian(GaussianPolicy),
    /// A score for every action: the logits of π, or the action-values Q(s, a). The action with the highest score is
    /// taken.
    Scored(Scores),
}

impl Policy {
    /// The layout of its parameters.
    pub fn layout(&self) -> PolicyLayout {
        match self {
            Self::Deterministic(network) => PolicyLayout::Deterministic(*network.layout()),
            Self::Gaussian(policy) => PolicyLayout::Gaussian(*policy.layout()),
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
            Self::Gaussian(policy) => policy.mean(parameters, observations, actions),
            Self::Scored(scores) => {
                let all_scores = scores.compute(parameters, observations);
                for (action, scores) in actions.iter_mut().zip(all_scores) {
                    *action = argmax(scores) as f32;
                }
            }
        }
    }
}

/// A deterministic policy with this network in an environment like `spec`, for at most `batch` observations a call.
///
/// # Errors
/// When the actions are not real numbers in finite ranges.
pub fn deterministic(
    network: NetworkLayout,
    spec: &EnvironmentSpec,
    batch: usize,
) -> Result<DeterministicPolicy, PolicyError> {
    let range = ActionRange::new(&spec.action)?;
    Ok(DeterministicPolicy::new(network, range, batch))
}

/// A squashed Gaussian policy with this network in an environment like `spec`, for at most `batch` observations a call.
///
/// # Errors
/// When the observations are not real numbers, or the actions are not real numbers in finite ranges.
pub fn gaussian(network: NetworkLayout, spec: &EnvironmentSpec, batch: usize) -> Result<GaussianPolicy, PolicyError> {
    let range = ActionRange::new(&spec.action)?;
    check_real_observations(spec)?;
    Ok(GaussianPolicy::new(network, range, batch))
}

/// A softmax policy with this network in an environment like `spec`, for at most `batch` observations a call.
///
/// # Errors
/// When the actions are not discrete, or the observations are not real numbers.
pub fn softmax(network: NetworkLayout, spec: &EnvironmentSpec, batch: usize) -> Result<Scores, PolicyError> {
    discrete_actions(spec)?;
    check_real_observations(spec)?;
    Ok(Scores::softmax(network, batch))
}

/// Action-values that this network computes, as dueling heads or directly, in an environment like `spec`, for at most
/// `batch` observations a call.
///
/// # Errors
/// When the actions are not discrete, or the observations are not real numbers.
pub fn action_values(
    network: NetworkLayout,
    dueling: bool,
    spec: &EnvironmentSpec,
    batch: usize,
) -> Result<Scores, PolicyError> {
    discrete_actions(spec)?;
    check_real_observations(spec)?;
    Ok(if dueling {
        Scores::dueling(network, batch)
    } else {
        Scores::values(network, batch)
    })
}

/// Checks that the observations are real numbers.
///
/// # Errors
/// When they are indices.
pub fn check_real_observations(spec: &EnvironmentSpec) -> Result<(), PolicyError> {
    match spec.observation {
        Space::Discrete { n, .. } => Err(PolicyError::RealObservationsRequired { n }),
        Space::Box { .. } => Ok(()),
    }
}

/// A table of action-values in an environment like `spec`, for at most `batch` observations a call.
///
/// # Errors
/// When observations or actions are not discrete.
pub fn table(spec: &EnvironmentSpec, batch: usize) -> Result<Scores, PolicyError> {
    let actions = discrete_actions(spec)?;
    match spec.observation {
        Space::Discrete { n, .. } => Ok(Scores::table(n as usize, actions, batch)),
        Space::Box { .. } => Err(PolicyError::DiscreteObservationsRequired),
    }
}

fn discrete_actions(spec: &EnvironmentSpec) -> Result<usize, PolicyError> {
    match spec.action {
        Space::Discrete { n, .. } => Ok(n as usize),
        Space::Box { .. } => Err(PolicyError::DiscreteActionsRequired),
    }
}

/// The index of the highest score; the first one of equal scores. A NaN is never higher than another score.
pub fn argmax(scores: &[f32]) -> usize {
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
    use crate::network::Hidden;

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
        let mut policy = Policy::Scored(table(&lake, 4).unwrap());
        assert_eq!(policy.layout().parameters(), 6);
        let mut actions = [f32::NAN; 4];
        policy.act(&[0.0, 1.0, 0.5, 0.5, 2.0, 1.0], &[0.0, 1.0, 2.0, 0.0], &mut actions);
        assert_eq!(actions, [1.0, 0.0, 0.0, 1.0]);
    }

    #[test]
    fn different_kinds_of_policies_have_different_fingerprints() {
        let network = NetworkLayout::new(4, Hidden::relu([10, 2]), 2);
        let kinds = [
            PolicyLayout::Deterministic(network),
            PolicyLayout::Gaussian(network),
            PolicyLayout::Softmax(network),
            PolicyLayout::ActionValues(network),
            PolicyLayout::Dueling(network),
        ];
        let fingerprints: std::collections::HashSet<u64> = kinds.iter().map(PolicyLayout::fingerprint).collect();
        assert_eq!(fingerprints.len(), kinds.len());
        assert_eq!(kinds[0].fingerprint(), network.fingerprint(), "as in existing files");
        let table = |states, actions| PolicyLayout::Table { states, actions }.fingerprint();
        assert_ne!(table(16, 4), table(4, 16));
    }
}
