//! `[environment]`, and `[spec]`, which the environment's server supplies.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::section::{OutOfRange, from};
use shoal_base::space::{EnvironmentSpec, Space};

/// Most numbers in an observation or an action: many more than any environment has, and few enough that no size computed
/// from them overflows.
const MAX_WIDTH: usize = 4_096;

/// The environment: its name and its parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EnvironmentConfig {
    /// The name of a built-in environment, or a name for an external server, such as `gym:Pendulum-v1`.
    #[schemars(extend("unit" = "–", "source" = "chapters 4 and 5"))]
    pub name: String,
    /// The command that starts the external environment server (`docs/PROTOCOL.md`); empty for built-in environments.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub server: Vec<String>,
    /// The environment's own parameters.
    #[serde(flatten)]
    #[schemars(skip)]
    pub parameters: toml::Table,
}

/// Checks an environment's description.
///
/// # Errors
/// For the first invalid value.
pub(super) fn check_spec(spec: &EnvironmentSpec) -> Result<(), OutOfRange> {
    check_size("spec.observation", &spec.observation)?;
    check_size("spec.action", &spec.action)?;
    from(1, 1_000_000).check("spec.time_limit", &spec.time_limit)
}

fn check_size(key: &str, space: &Space) -> Result<(), OutOfRange> {
    let (value, expected) = match space {
        Space::Discrete { n: 0 } => ("no index".into(), "one index or more".into()),
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
