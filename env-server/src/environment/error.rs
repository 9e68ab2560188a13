//! Errors of an environment: in its configuration, which the user corrects, or in a request, which the client corrects.

use std::ops::RangeInclusive;

use shoal_base::section::{in_user_words, refusal};

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

/// A parameter outside its range.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("`{key}` is {value}: give a number from {low} to {high}")]
pub struct OutOfRange {
    key: &'static str,
    value: f64,
    low: f64,
    high: f64,
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

/// Refuses a `value` outside `range`, and NaN.
pub(super) fn check(key: &'static str, value: f64, range: RangeInclusive<f64>) -> Result<(), OutOfRange> {
    let (low, high) = range.into_inner();
    if low <= value && value <= high {
        Ok(())
    } else {
        Err(OutOfRange { key, value, low, high })
    }
}

/// Checks the parameter that every environment has.
pub(super) fn check_time_limit(time_limit: u32) -> Result<(), OutOfRange> {
    check("time_limit", time_limit.into(), 1.0..=1e6)
}

/// An error about one of these parameters, as one line with the parameter's value.
pub(super) fn wrong_parameter(parameters: &toml::Table, error: &toml::de::Error) -> String {
    let reason = in_user_words(error.message());
    // The key stands only in the whole text.
    let text = error.to_string();
    let place = text
        .lines()
        .find_map(|line| line.strip_prefix("in `")?.strip_suffix('`'));
    match place.and_then(|key| parameters.get_key_value(key)) {
        Some((key, value)) => refusal(key, value, &reason),
        None => reason,
    }
}
