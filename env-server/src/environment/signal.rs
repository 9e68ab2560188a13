//! What an environment's numbers mean: its signals, its goal, and what is drawn of it.

use serde::Serialize;
use shoal_base::space::{EnvironmentSpec, Space};

/// How many numbers of an observation, and how many of an action, are signals where nothing names them.
const BY_NUMBER: usize = 8;

/// A number that changes from step to step, and what it means.
#[derive(Clone, Debug, PartialEq)]
pub struct Signal {
    /// Programs find it by this. It stays the same and is unique within an environment.
    pub key: String,
    /// People read this.
    pub label: String,
    /// Empty for what is counted.
    pub unit: &'static str,
    /// Where its values come from.
    pub source: Source,
}

/// Where a signal's values come from. Indices count from 0.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Source {
    /// A number of the observation.
    Observation(usize),
    /// A number of the action.
    Action(usize),
    /// The angle in rad that has its cosine and its sine in these numbers of the observation. It turns by less than half a
    /// turn a step, so it is followed through whole turns.
    Angle {
        /// Index of the cosine.
        cos: usize,
        /// Index of the sine.
        sin: usize,
    },
}

impl Signal {
    /// Number `index` of the observation. The label is the key until `label` gives another.
    pub fn observation(index: usize, key: &str, unit: &'static str) -> Self {
        Self::new(key, unit, Source::Observation(index))
    }

    /// Number `index` of the action, in environment units.
    pub fn action(index: usize, key: &str, unit: &'static str) -> Self {
        Self::new(key, unit, Source::Action(index))
    }

    /// The angle in rad whose cosine and sine are these numbers of the observation.
    pub fn angle(cos: usize, sin: usize, key: &str) -> Self {
        Self::new(key, "rad", Source::Angle { cos, sin })
    }

    fn new(key: &str, unit: &'static str, source: Source) -> Self {
        Self {
            key: key.into(),
            label: key.into(),
            unit,
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

    /// The first eight numbers of the observation and of the action, called by their place: what is known of an
    /// environment that names no signals.
    pub fn by_number(spec: &EnvironmentSpec) -> Vec<Self> {
        let signals = |space: &Space, called: &'static str, source: fn(usize) -> Source| {
            (0..space.width().min(BY_NUMBER)).map(move |i| {
                let number = i + 1;
                Self::new(&format!("{called}-{number}"), "", source(i)).label(&format!("{called} {number}"))
            })
        };
        let observed = signals(&spec.observation, "observation", Source::Observation);
        observed
            .chain(signals(&spec.action, "action", Source::Action))
            .collect()
    }

    /// The least and the greatest value, as the spaces say them; `None` where there is no such bound.
    pub fn range(&self, spec: &EnvironmentSpec) -> Option<[f64; 2]> {
        let (space, i) = match self.source {
            Source::Observation(i) => (&spec.observation, i),
            Source::Action(i) => (&spec.action, i),
            Source::Angle { .. } => return None,
        };
        let range = match space {
            Space::Box { low, high } => [f64::from(*low.get(i)?), f64::from(*high.get(i)?)],
            Space::Discrete { n, .. } => [0.0, f64::from(n.saturating_sub(1))],
        };
        range.iter().all(|bound| bound.is_finite()).then_some(range)
    }
}

/// What success is at an episode's end: a distance below a bound.
#[derive(Clone, Debug, PartialEq)]
pub struct Goal {
    /// The distance to the goal.
    pub distance: Signal,
    /// Nearer than this the goal is reached, in the distance's unit.
    pub within: f64,
}

/// What the report draws of an episode. A picture reads the signals that `keys` names, and the ranges that `scales` names.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Picture {
    /// Nothing: the signals are shown as lines.
    #[default]
    None,
    /// A rod on a joint. `angle` in rad, 0 upright and growing counterclockwise; `torque` in N m.
    Rod,
    /// A body on a square seen from above, with its goal in the middle. `x` and `y` in m; `force` in N; `direction` in rad.
    Plane,
    /// A pole on a cart. `position` in m; `angle` in rad, 0 upright and growing clockwise; `push` 0 to the left, 1 to the right.
    Cart {
        /// The track ends at this |x|, in m.
        track: f64,
        /// The pole's length, in m.
        pole: f64,
    },
    /// A walk over a square of fields. `field` is the field's number, row by row; `direction` is 0 left, 1 down, 2 right, 3 up.
    Grid {
        /// A letter for each field, row by row: S the start, F free, H a hole, G the goal.
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

    /// Those of the keys whose signals must have a range: it sets the picture's scale.
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
    fn numbers_without_a_name_are_called_by_their_place() {
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
    fn a_range_is_what_the_space_says_and_finite() {
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
