//! `[environment]`, and `[spec]`, which the environment says of itself.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::section::{OutOfRange, from};
use shoal_base::space::{EnvironmentSpec, Space};

/// Numbers in an observation or an action: many more than any environment has, and few enough that sizes computed from
/// them stay far from overflowing.
const WIDEST: usize = 4_096;

/// What is controlled: an environment's name, and the parameters that this environment understands.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct EnvironmentConfig {
    /// One of the environments' names, or what another program makes an environment from, as `gym:Pendulum-v1`.
    #[schemars(extend("unit" = "–", "source" = "chapters 4 and 5"))]
    pub name: String,
    /// The command that starts that program, an environment server as `docs/PROTOCOL.md` has it; empty for our own.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    #[schemars(extend("unit" = "–", "source" = "ours"))]
    pub server: Vec<String>,
    /// The environment's own parameters.
    #[serde(flatten)]
    #[schemars(skip)]
    pub parameters: toml::Table,
}

/// Whether what an environment says of itself makes sense.
///
/// # Errors
/// For the first thing that does not.
pub(super) fn check_spec(spec: &EnvironmentSpec) -> Result<(), OutOfRange> {
    check_size("spec.observation", &spec.observation)?;
    check_size("spec.action", &spec.action)?;
    from(1, 1_000_000).check("spec.time_limit", &spec.time_limit)
}

fn check_size(key: &str, space: &Space) -> Result<(), OutOfRange> {
    let (value, expected) = match space {
        Space::Discrete { n: 0 } => ("no index at all".into(), "one index or more".into()),
        Space::Box { low, high } if low.len() != high.len() || !(1..=WIDEST).contains(&low.len()) => (
            format!("{} lower and {} upper bounds", low.len(), high.len()),
            format!("as many of each, from 1 to {WIDEST}"),
        ),
        _ => return Ok(()),
    };
    Err(OutOfRange {
        key: key.into(),
        value,
        expected,
    })
}
