//! What an observation or an action may be.

use serde::{Deserialize, Serialize};

/// The set an observation or an action comes from. Every element travels as `width()` numbers of `f32`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase", deny_unknown_fields)]
pub enum Space {
    /// Real vectors; element `i` lies within `low[i] ..= high[i]` (which may be infinite).
    Box {
        /// Least value of each element.
        low: Vec<f32>,
        /// Greatest value of each element.
        high: Vec<f32>,
    },
    /// One of the indices `0 .. n`, carried as one `f32`.
    Discrete {
        /// How many indices there are.
        n: u32,
    },
}

impl Space {
    /// A box from its `(low, high)` pairs.
    pub fn boxed(ranges: &[(f32, f32)]) -> Self {
        Self::Box {
            low: ranges.iter().map(|r| r.0).collect(),
            high: ranges.iter().map(|r| r.1).collect(),
        }
    }

    /// Numbers an element of the space takes in a row, a request or a response.
    pub fn width(&self) -> usize {
        match self {
            Self::Box { low, .. } => low.len(),
            Self::Discrete { .. } => 1,
        }
    }
}

/// What an agent has to know of an environment before its first step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EnvironmentSpec {
    /// What the agent sees.
    pub observation: Space,
    /// What the agent does.
    pub action: Space,
    /// Steps after which an episode is truncated.
    pub time_limit: u32,
}
