//! Spaces of observations and actions.

use serde::{Deserialize, Serialize};

/// The longest time limit of an environment, in steps.
pub const MAX_TIME_LIMIT: u32 = 1_000_000;

/// The most environments of an actor.
pub const MAX_ENVS: u32 = 4_096;

/// A 32-bit float has every whole number up to this one.
pub const MAX_EXACT_INTEGER: u32 = 1 << 24;

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

    /// How this space, that of `what`, differs from the `configured` one, in words; `None` if they match.
    fn difference(&self, what: &str, configured: &Self) -> Option<String> {
        if self.matches(configured) {
            return None;
        }
        let (here, there) = (self.in_words(), configured.in_words());
        Some(if here == there {
            format!("its {what} have other bounds than the run's")
        } else {
            format!("its {what} are {here}, the run's {there}")
        })
    }

    /// The kind and the size of the space.
    fn in_words(&self) -> String {
        match (self, self.size()) {
            (Self::Box { .. }, 1) => "a number".into(),
            (Self::Box { .. }, size) => format!("{size} numbers"),
            (Self::Discrete { .. }, 1) => "one index".into(),
            (Self::Discrete { .. }, size) => format!("{size} indices"),
        }
    }

    /// Numbers that an element takes in a row, a request or a response.
    pub fn width(&self) -> usize {
        match self {
            Self::Box { low, .. } => low.len(),
            Self::Discrete { .. } => 1,
        }
    }

    /// The outputs of a network that has one for each index of a discrete space, or for each number of a box.
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
    /// The first difference between this description of an environment and the `configured` one of a run, in words;
    /// `None` if they match.
    pub fn difference(&self, configured: &Self) -> Option<String> {
        let number = |what: &str, here: usize, there: usize| {
            (here != there).then(|| format!("its {what} is {here}, the run's {there}"))
        };
        let limits = (self.time_limit as usize, configured.time_limit as usize);
        self.observation
            .difference("observations", &configured.observation)
            .or_else(|| self.action.difference("actions", &configured.action))
            .or_else(|| number("time limit", limits.0, limits.1))
            .or_else(|| number("count of numbers in a state", self.state_width, configured.state_width))
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
    fn the_first_difference_is_named_and_a_run_of_an_earlier_version_has_any_start() {
        type Change = fn(&mut EnvironmentSpec);
        let configured = EnvironmentSpec {
            observation: Space::boxed(&[(-1.0, 1.0); 3]),
            action: Space::discrete(4),
            time_limit: 100,
            state_width: 2,
        };
        let changes: [(Change, Option<&str>); 7] = [
            (|_| (), None),
            (|spec| spec.action = Space::Discrete { n: 4, start: 1 }, None),
            (
                |spec| spec.observation = Space::boxed(&[(-1.0, 1.0)]),
                Some("its observations are a number, the run's 3 numbers"),
            ),
            (
                |spec| spec.observation = Space::boxed(&[(-1.0, 2.0); 3]),
                Some("its observations have other bounds than the run's"),
            ),
            (
                |spec| (spec.action, spec.time_limit) = (Space::discrete(5), 50),
                Some("its actions are 5 indices, the run's 4 indices"),
            ),
            (|spec| spec.time_limit = 50, Some("its time limit is 50, the run's 100")),
            (
                |spec| spec.state_width = 0,
                Some("its count of numbers in a state is 0, the run's 2"),
            ),
        ];
        for (change, words) in changes {
            let mut served = configured.clone();
            change(&mut served);
            assert_eq!(served.difference(&configured).as_deref(), words);
        }
    }

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
