//! The format number of a run's identity (`identity.rs`).

use serde::{Deserialize, Serialize};

/// The format of a run's identity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "u32", into = "u32")]
pub enum IdentityFormat {
    /// The format of runs whose configuration has no format number.
    #[default]
    Unnumbered,
    /// Format 1.
    One,
}

impl IdentityFormat {
    /// The format of new runs.
    pub const NEWEST: Self = Self::One;

    /// Whether the configuration has no format number.
    pub(super) fn is_unnumbered(&self) -> bool {
        *self == Self::Unnumbered
    }
}

impl TryFrom<u32> for IdentityFormat {
    type Error = String;

    fn try_from(number: u32) -> Result<Self, String> {
        match number {
            0 => Ok(Self::Unnumbered),
            1 => Ok(Self::One),
            other => Err(format!(
                "run.identity_format = {other}: this program knows formats up to 1; use the version of the program \
                 that wrote this configuration"
            )),
        }
    }
}

impl From<IdentityFormat> for u32 {
    fn from(format: IdentityFormat) -> Self {
        match format {
            IdentityFormat::Unnumbered => 0,
            IdentityFormat::One => 1,
        }
    }
}
