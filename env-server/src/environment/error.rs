//! What can be wrong with an environment: its configuration (a person corrects it), or a request (the client does).

use std::ops::RangeInclusive;

/// An environment that cannot be made. Each message is one line for a person.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum EnvironmentError {
    /// No environment has this name.
    #[error("unknown environment `{name}`: choose one of {known}")]
    UnknownName {
        /// The name asked for.
        name: String,
        /// The names there are, with commas.
        known: String,
    },
    /// A parameter is unknown, of the wrong type or out of its range.
    #[error("environment {environment}: {reason}")]
    Parameters {
        /// The environment's name.
        environment: &'static str,
        /// Which parameter, and what it may be.
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
        /// The states there are.
        expected: &'static str,
    },
    /// Not as many numbers as the environments together take.
    #[error("{given} numbers of {what} for {environments} environments: give {expected}")]
    Count {
        /// Actions, states, episodes or snapshot.
        what: &'static str,
        /// How many came.
        given: usize,
        /// How many environments there are.
        environments: usize,
        /// How many numbers are wanted, in words.
        expected: String,
    },
    /// An action that is not finite, or no index of a discrete action.
    #[error("action {action} of environment {environment} is not in its action space: is the policy diverging?")]
    Action {
        /// Which environment of the vector.
        environment: usize,
        /// The offending number.
        action: f32,
    },
    /// A snapshot of environments that cannot say their state.
    #[error("this environment cannot say its state: there are no snapshots of it")]
    Unsayable,
    /// A snapshot while no training episodes are under way.
    #[error("no training episodes are under way: reset or restore first")]
    NoTraining,
    /// Words that say what no episode can come to.
    #[error("no snapshot: environment {environment} cannot have this {what}")]
    Snapshot {
        /// Which environment of the vector.
        environment: usize,
        /// Which part of its words.
        what: &'static str,
    },
}

/// Lets `value` pass when it lies in `range`; NaN never does.
pub(super) fn check(key: &'static str, value: f64, range: RangeInclusive<f64>) -> Result<(), OutOfRange> {
    let (low, high) = range.into_inner();
    if low <= value && value <= high {
        Ok(())
    } else {
        Err(OutOfRange { key, value, low, high })
    }
}

/// `check` for the parameter that every environment has.
pub(super) fn check_time_limit(time_limit: u32) -> Result<(), OutOfRange> {
    check("time_limit", time_limit.into(), 1.0..=1e6)
}

/// The one-line form of a TOML error, in words for people who do not write Rust.
pub(super) fn for_people(error: &toml::de::Error) -> String {
    let line = error.to_string().split_whitespace().collect::<Vec<_>>().join(" ");
    line.replace("expected f64", "expected a number")
        .replace("expected u32", "expected a positive whole number")
}
