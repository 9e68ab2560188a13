//! Errors of an environment: in its configuration, which the user corrects, or in a request, which the client corrects.

use std::ops::RangeInclusive;

pub use shoal_base::section::OutOfRange;
use shoal_base::section::{from, in_user_words, refusal};
use shoal_base::space::MAX_TIME_LIMIT;

/// Why an environment cannot be made. Each message is one line for the user.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EnvironmentError {
    /// No environment has this name.
    #[error("unknown environment `{name}`: choose one of {known}")]
    UnknownName {
        /// The name asked for.
        name: String,
        /// The known names, separated by commas.
        known: String,
    },
    /// A parameter is unknown, of the wrong type or out of its range.
    #[error("environment {environment}: {reason}")]
    Parameters {
        /// The environment's name.
        environment: &'static str,
        /// The parameter and its valid values.
        reason: String,
    },
}

/// A request that a running environment refuses.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RequestError {
    /// `reset_to` or `restore` with a state that the environment cannot be in.
    #[error("the environment cannot be in state {state:?}: give {expected}")]
    State {
        /// The state asked for.
        state: Vec<f64>,
        /// The valid states, in words.
        expected: &'static str,
    },
    /// A wrong count of numbers for all environments together.
    #[error("{what}: {given} numbers for {environments} environments; give {expected}")]
    Count {
        /// `actions`, `states`, `episodes` or `snapshot`.
        what: &'static str,
        /// How many were given.
        given: usize,
        /// How many environments there are.
        environments: usize,
        /// How many are expected, in words.
        expected: String,
    },
    /// An action that is not finite, or not an index of a discrete action.
    #[error("action {action} of environment {environment} is not in its action space: is the policy diverging?")]
    Action {
        /// The environment's index in the vector.
        environment: usize,
        /// The offending number.
        action: f32,
    },
    /// A snapshot of environments that cannot save their state.
    #[error("this environment cannot save its state, so it has no snapshots")]
    NoSnapshots,
    /// A snapshot outside training episodes.
    #[error("the environments are not in training episodes: reset or restore them first")]
    NoTraining,
    /// A snapshot with a value that no episode can have.
    #[error("invalid snapshot: environment {environment} cannot have this {what}")]
    Snapshot {
        /// The environment's index in the vector.
        environment: usize,
        /// Which value of its snapshot.
        what: &'static str,
    },
}

/// Checks the value of a parameter.
///
/// ```
/// let refused = shoal_env_server::environment::check("mass", -1.0, 0.1..=10.0).unwrap_err();
/// assert_eq!(refused.to_string(), "mass = -1: must be from 0.1 to 10");
/// ```
///
/// # Errors
/// When it is outside `range`, or NaN.
pub fn check(key: &str, value: f64, range: RangeInclusive<f64>) -> Result<(), OutOfRange> {
    let (low, high) = range.into_inner();
    from(low, high).check(key, &value)
}

/// Checks the parameter that every environment has, the steps after which an episode is truncated.
///
/// # Errors
/// When it is 0 or above a million.
pub fn check_time_limit(time_limit: u32) -> Result<(), OutOfRange> {
    check("time_limit", time_limit.into(), 1.0..=f64::from(MAX_TIME_LIMIT))
}

/// An error about one of these parameters, as one line with the parameter's value.
pub(super) fn wrong_parameter(parameters: &toml::Table, error: &toml::de::Error) -> String {
    let reason = in_user_words(error.message());
    // Only the error's full text names the key.
    let text = error.to_string();
    let place = text
        .lines()
        .find_map(|line| line.strip_prefix("in `")?.strip_suffix('`'));
    match place.and_then(|key| parameters.get_key_value(key)) {
        Some((key, value)) => refusal(key, value, &reason),
        None => reason,
    }
}
