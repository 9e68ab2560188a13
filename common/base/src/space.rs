//! Spaces of observations and actions.

use serde::{Deserialize, Serialize};

/// The set of possible observations or actions. An element is stored as `width()` numbers of `f32`.
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
    /// One of the indices `0 .. n`, stored as one `f32`.
    Discrete {
        /// Number of indices.
        n: u32,
        /// The environment's own number for index 0. Only exported policies use it.
        #[serde(default, skip_serializing_if = "is_zero")]
        start: i32,
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

    /// The indices `0 .. n`.
    pub fn discrete(n: u32) -> Self {
        Self::Discrete { n, start: 0 }
    }

    /// The environment's own number for index 0; 0 for a box.
    pub fn start(&self) -> i32 {
        match self {
            Self::Box { .. } => 0,
            Self::Discrete { start, .. } => *start,
        }
    }

    /// Whether this space matches the `configured` one. Configurations of earlier versions have no `start`, so 0
    /// matches any.
    fn matches(&self, configured: &Self) -> bool {
        match (self, configured) {
            (Self::Discrete { n, .. }, Self::Discrete { n: expected, start: 0 }) => n == expected,
            _ => self == configured,
        }
    }

    /// Numbers that an element takes in a row, a request or a response.
    pub fn width(&self) -> usize {
        match self {
            Self::Box { low, .. } => low.len(),
            Self::Discrete { .. } => 1,
        }
    }

    /// Number of indices, or numbers in an element: the width of a network's output layer with one output for each.
    pub fn size(&self) -> usize {
        match self {
            Self::Box { low, .. } => low.len(),
            Self::Discrete { n, .. } => *n as usize,
        }
    }
}

/// What an agent must know about an environment before its first step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EnvironmentSpec {
    /// The space of observations.
    pub observation: Space,
    /// The space of actions.
    pub action: Space,
    /// Steps after which an episode is truncated.
    pub time_limit: u32,
    /// Numbers (`f64`) in the environment's saved state; 0 if the environment cannot save its state.
    #[serde(default)]
    pub state_width: usize,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde requires this signature")]
fn is_zero(number: &i32) -> bool {
    *number == 0
}

impl EnvironmentSpec {
    /// Whether this description of an environment matches the `configured` one.
    pub fn matches(&self, configured: &Self) -> bool {
        self.observation.matches(&configured.observation)
            && self.action.matches(&configured.action)
            && (self.time_limit, self.state_width) == (configured.time_limit, configured.state_width)
    }

    /// Words in a snapshot of this many environments. For each environment: the number of its episode, the steps taken
    /// in it, the position in its random stream, and the state. 0 if the environment cannot save its state.
    pub fn snapshot_words(&self, environments: usize) -> usize {
        const COUNTERS: usize = 3;
        match self.state_width {
            0 => 0,
            state => environments * (COUNTERS + state),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_environment_that_cannot_save_its_state_has_no_snapshots() {
        let lake = |state_width| EnvironmentSpec {
            observation: Space::discrete(16),
            action: Space::discrete(4),
            time_limit: 100,
            state_width,
        };
        assert_eq!([0, 1, 2].map(|state| lake(state).snapshot_words(5)), [0, 20, 25]);
    }
}
