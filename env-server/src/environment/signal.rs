//! The meaning of an environment's numbers: its signals, its goal, and its picture.

use serde::{Deserialize, Serialize};
use shoal_base::space::{EnvironmentSpec, Space};

/// If an environment names no signals, at most this many numbers of its observation, and of its action, become signals.
const MAX_UNNAMED: usize = 8;

/// A number that changes from step to step, with its meaning.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Signal {
    /// Identifies the signal to programs. It never changes and is unique within an environment.
    pub key: String,
    /// Shown to the user.
    pub label: String,
    /// Empty for counts and indices.
    #[serde(default)]
    pub unit: String,
    /// Where its values come from.
    #[serde(flatten)]
    pub source: SignalSource,
}

/// Where a signal's values come from. Indices count from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SignalSource {
    /// A number of the observation.
    Observation(usize),
    /// A number of the action.
    Action(usize),
    /// An angle in rad whose cosine and sine are numbers of the observation. It is unwrapped across whole turns, so it
    /// must change by less than half a turn per step.
    Angle {
        /// Index of the cosine.
        cos: usize,
        /// Index of the sine.
        sin: usize,
    },
}

impl Signal {
    /// Number `index` of the observation. The label is the key unless `label` sets another.
    pub fn observation(index: usize, key: &str, unit: &str) -> Self {
        Self::new(key, unit, SignalSource::Observation(index))
    }

    /// Number `index` of the action, in environment units.
    pub fn action(index: usize, key: &str, unit: &str) -> Self {
        Self::new(key, unit, SignalSource::Action(index))
    }

    /// The angle in rad whose cosine and sine are these numbers of the observation.
    pub fn angle(cos: usize, sin: usize, key: &str) -> Self {
        Self::new(key, "rad", SignalSource::Angle { cos, sin })
    }

    fn new(key: &str, unit: &str, source: SignalSource) -> Self {
        Self {
            key: key.into(),
            label: key.into(),
            unit: unit.into(),
            source,
        }
    }

    /// The same signal with another label.
    #[must_use]
    pub fn label(self, label: &str) -> Self {
        Self {
            label: label.into(),
            ..self
        }
    }

    /// The first eight numbers of the observation and of the action, named by their position, for an environment that
    /// names no signals.
    pub fn by_number(spec: &EnvironmentSpec) -> Vec<Self> {
        let signals = |space: &Space, name: &'static str, source: fn(usize) -> SignalSource| {
            (0..space.width().min(MAX_UNNAMED)).map(move |i| {
                let number = i + 1;
                Self::new(&format!("{name}-{number}"), "", source(i)).label(&format!("{name} {number}"))
            })
        };
        let observed = signals(&spec.observation, "observation", SignalSource::Observation);
        observed
            .chain(signals(&spec.action, "action", SignalSource::Action))
            .collect()
    }

    /// The least and the greatest value according to the spaces; `None` if there are no finite bounds.
    pub fn range(&self, spec: &EnvironmentSpec) -> Option<[f64; 2]> {
        let (space, i) = match self.source {
            SignalSource::Observation(i) => (&spec.observation, i),
            SignalSource::Action(i) => (&spec.action, i),
            SignalSource::Angle { .. } => return None,
        };
        let range = match space {
            Space::Box { low, high } => [f64::from(*low.get(i)?), f64::from(*high.get(i)?)],
            Space::Discrete { n, .. } => [0.0, f64::from(n.saturating_sub(1))],
        };
        range.iter().all(|bound| bound.is_finite()).then_some(range)
    }
}

/// The criterion of success at an episode's end: a distance below a bound.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Goal {
    /// The distance to the goal.
    pub distance: Signal,
    /// The goal is reached below this distance, in the distance's unit.
    pub within: f64,
}

/// What the report draws of an episode, from the signals in `keys`, with the ranges of the signals in `scales`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Picture {
    /// Nothing; the signals are shown as lines.
    #[default]
    None,
    /// A rod on a joint. `angle` in rad, 0 upright and growing counterclockwise; `torque` in N m.
    Rod,
    /// A body on a square, seen from above, with its goal in the middle. `x` and `y` in m; `force` in N; `direction` in
    /// rad.
    Plane,
    /// A pole on a cart. `position` in m; `angle` in rad, 0 upright and growing clockwise; `push` is 0 to the left, 1
    /// to the right.
    Cart {
        /// The track ends at this |x|, in m.
        track: f64,
        /// The pole's length, in m.
        pole: f64,
    },
    /// An agent on a square grid. `field` is the number of the cell, row by row; `direction` is 0 left, 1 down, 2 right,
    /// 3 up.
    Grid {
        /// A letter for each cell, row by row: S the start, F free, H a hole, G the goal.
        map: String,
    },
}

impl Picture {
    /// The keys of the signals that it reads.
    pub fn keys(&self) -> &'static [&'static str] {
        match self {
            Self::None => &[],
            Self::Rod => &["angle", "torque"],
            Self::Plane => &["x", "y", "force", "direction"],
            Self::Cart { .. } => &["position", "angle", "push"],
            Self::Grid { .. } => &["field", "direction"],
        }
    }

    /// The keys whose signals must have a range, because it sets the picture's scale.
    pub fn scales(&self) -> &'static [&'static str] {
        match self {
            Self::None | Self::Cart { .. } | Self::Grid { .. } => &[],
            Self::Rod => &["torque"],
            Self::Plane => &["x", "force"],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(observation: Space, action: Space) -> EnvironmentSpec {
        EnvironmentSpec {
            observation,
            action,
            time_limit: 1,
            state_width: 0,
        }
    }

    #[test]
    fn unnamed_signals_are_named_by_their_position() {
        let wide = Space::boxed(&[(0.0, 1.0); 30]);
        let signals = Signal::by_number(&spec(wide, Space::discrete(3)));
        assert_eq!(signals.len(), 8 + 1);
        assert_eq!(
            signals[7],
            Signal::observation(7, "observation-8", "").label("observation 8")
        );
        assert_eq!(signals[8], Signal::action(0, "action-1", "").label("action 1"));
    }

    #[test]
    fn a_range_is_that_of_the_space_and_finite() {
        let spec = spec(
            Space::boxed(&[(-4.0, 4.0), (f32::NEG_INFINITY, 1.0)]),
            Space::discrete(3),
        );
        let range = |signal: Signal| signal.range(&spec);
        assert_eq!(range(Signal::observation(0, "x", "m")), Some([-4.0, 4.0]));
        assert_eq!(range(Signal::observation(1, "v", "m/s")), None);
        assert_eq!(range(Signal::observation(2, "nothing", "")), None);
        assert_eq!(range(Signal::action(0, "direction", "")), Some([0.0, 2.0]));
        assert_eq!(range(Signal::angle(0, 1, "angle")), None);
    }
}
