//! `[environment]`, and `[spec]`, which the environment's server supplies.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::section::{Change, OutOfRange, from, never};
use shoal_base::space::{EnvironmentSpec, MAX_EXACT_INTEGER, MAX_TIME_LIMIT, Space};

/// Most numbers in an observation or an action: many more than any environment has, and few enough that no size
/// computed from them overflows.
const MAX_WIDTH: usize = 4_096;

/// Why the environment of a run and its parameters never change.
pub(super) const CHANGES_ROWS: &str = "the rows in the replay come from this environment";

/// Why the command of an environment's server never changes.
const CHANGES_SERVER: &str = "the rows in the replay come from it; if its program has moved, edit server.json";

/// The environment: its name and its parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EnvironmentConfig {
    /// The name of a built-in environment, or a name for an external server, such as `gym:Pendulum-v1`.
    #[schemars(extend("unit" = "–", "source" = "chapters 4 and 5", "change" = never(CHANGES_ROWS)))]
    pub name: String,
    /// The command that starts the external environment server (`docs/PROTOCOL.md`); empty for built-in environments.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("unit" = "–", "source" = "ours", "change" = never(CHANGES_SERVER)))]
    pub server: Vec<String>,
    /// The run ends after this many invalid answers, such as an infinite reward. After each one, the server's episodes
    /// are dropped and new ones begin.
    #[serde(default = "default_faults", skip_serializing_if = "is_default_faults")]
    #[schemars(extend("unit" = "answers", "source" = "ours", "change" = Change::Anytime))]
    pub faults: u32,
    /// How long the server may take to start. After 10 s the terminal shows which server the run waits for. Where a
    /// command asks the server itself (`eval`, `film`, `plot`, `report`, and the final evaluation), this is also the
    /// limit of each reset and step.
    #[serde(default = "default_start_seconds", skip_serializing_if = "is_default_start_seconds")]
    #[schemars(extend("unit" = "s", "source" = "ours", "change" = Change::Anytime))]
    pub start_seconds: u32,
    /// The environment's own parameters.
    #[serde(flatten)]
    #[schemars(skip)]
    pub parameters: toml::Table,
}

/// More than a simulator's rare faults in an hour, and few enough that a broken environment is noticed soon.
fn default_faults() -> u32 {
    100
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde requires this signature")]
fn is_default_faults(number: &u32) -> bool {
    *number == default_faults()
}

/// Long enough to load the libraries of a simulator.
fn default_start_seconds() -> u32 {
    120
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde requires this signature")]
fn is_default_start_seconds(number: &u32) -> bool {
    *number == default_start_seconds()
}

impl EnvironmentConfig {
    /// An environment with the default limits.
    pub fn new(name: String, server: Vec<String>, parameters: toml::Table) -> Self {
        Self {
            name,
            server,
            faults: default_faults(),
            start_seconds: default_start_seconds(),
            parameters,
        }
    }

    /// Whether another program serves it.
    pub fn is_external(&self) -> bool {
        !self.server.is_empty()
    }

    /// How long its server may take to start.
    pub fn start_limit(&self) -> Duration {
        Duration::from_secs(self.start_seconds.into())
    }

    /// Checks the limits.
    ///
    /// # Errors
    /// For the first invalid limit.
    pub(super) fn check(&self) -> Result<(), OutOfRange> {
        from(1, u32::MAX).check("environment.faults", &self.faults)?;
        from(1, 86_400).check("environment.start_seconds", &self.start_seconds)
    }
}

/// Checks an environment's description.
///
/// # Errors
/// For the first invalid value.
pub(super) fn check_spec(spec: &EnvironmentSpec) -> Result<(), OutOfRange> {
    check_size("spec.observation", &spec.observation)?;
    check_size("spec.action", &spec.action)?;
    from(1, MAX_TIME_LIMIT).check("spec.time_limit", &spec.time_limit)
}

fn check_size(key: &str, space: &Space) -> Result<(), OutOfRange> {
    let (value, expected) = match space {
        Space::Discrete { n: 0, .. } => ("no index".into(), "one index or more".into()),
        // Rows and requests have the numbers of states and actions as 32-bit floats.
        Space::Discrete { n, .. } if *n > MAX_EXACT_INTEGER => (
            format!("{n} indices"),
            format!("at most {MAX_EXACT_INTEGER} (2^24) indices: choose an environment with fewer"),
        ),
        Space::Box { low, high } if low.len() != high.len() || !(1..=MAX_WIDTH).contains(&low.len()) => (
            format!("{} lower and {} upper bounds", low.len(), high.len()),
            format!("equally many of both, from 1 to {MAX_WIDTH}"),
        ),
        _ => return Ok(()),
    };
    Err(OutOfRange {
        key: key.into(),
        value,
        expected,
    })
}
