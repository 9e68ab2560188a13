//! Which form the text has that a run's files are known by (`identity.rs`).

use serde::{Deserialize, Serialize};

/// The form of a run's identity.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "u32", into = "u32")]
pub enum IdentityFormat {
    /// That of runs whose configuration notes no form.
    #[default]
    Unnumbered,
    /// That of runs made now.
    One,
}

impl IdentityFormat {
    /// The form of runs made now.
    pub const NEWEST: Self = Self::One;

    /// Whether none is noted.
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
                "run.identity_format = {other}: this version of the program knows 1 and nothing newer"
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
