//! A cart on a rail, to be brought to the middle and kept there.

use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::{
    space::{EnvironmentSpec, Space},
    stream::Stream,
};

use super::{Class, Drawing, Environment, OutOfRange, RequestError, Signal, Step, check_time_limit};

/// Δt in s.
const DT: f64 = 0.05;
/// Greatest |x| in m and |v| in m/s: the rail has buffers at its ends.
const X: f64 = 2.0;
const V: f64 = 2.0;

/// The environment's parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Parameters {
    /// Steps after which an episode is truncated.
    #[schemars(extend("unit" = "steps", "source" = "ours"))]
    pub time_limit: u32,
}

impl Default for Parameters {
    fn default() -> Self {
        Self { time_limit: 100 }
    }
}

/// A cart of 1 kg. Observation (x, v), action (force in N, from −1 to 1), reward −x² − 0.1 v² in each step. Never
/// terminates.
#[derive(Clone, Debug)]
pub struct Rail {
    parameters: Parameters,
    /// In m.
    x: f64,
    /// In m/s.
    v: f64,
}

impl Rail {
    /// At rest in the middle.
    pub fn new(parameters: Parameters) -> Result<Self, OutOfRange> {
        check_time_limit(parameters.time_limit)?;
        Ok(Self {
            parameters,
            x: 0.0,
            v: 0.0,
        })
    }
}

impl Environment for Rail {
    fn spec(&self) -> EnvironmentSpec {
        EnvironmentSpec {
            observation: Space::boxed(&[(-X as f32, X as f32), (-V as f32, V as f32)]),
            action: Space::boxed(&[(-1.0, 1.0)]),
            time_limit: self.parameters.time_limit,
            state_width: 2,
        }
    }

    fn reset(&mut self, rng: &mut Stream) {
        (self.x, self.v) = (rng.random_range(-X..=X), 0.0);
    }

    fn reset_to(&mut self, state: &[f64]) -> Result<(), RequestError> {
        match *state {
            [x, v] if x.abs() <= X && v.abs() <= V => {
                (self.x, self.v) = (x, v);
                Ok(())
            }
            _ => Err(RequestError::State {
                state: state.to_vec(),
                expected: "position in m and velocity in m/s, each from -2 to 2",
            }),
        }
    }

    fn observe(&self, observation: &mut [f32]) {
        observation.copy_from_slice(&[self.x as f32, self.v as f32]);
    }

    fn step(&mut self, action: &[f64], _rng: &mut Stream) -> Step {
        let force = action[0].clamp(-1.0, 1.0);
        self.v = (self.v + force * DT).clamp(-V, V);
        self.x = (self.x + self.v * DT).clamp(-X, X);
        Step {
            reward: -self.x.powi(2) - 0.1 * self.v.powi(2),
            terminated: false,
        }
    }

    fn save(&self, state: &mut [f64]) {
        state.copy_from_slice(&[self.x, self.v]);
    }

    fn signals(&self) -> Vec<Signal> {
        vec![
            Signal::observation(0, "position", "m"),
            Signal::observation(1, "velocity", "m/s"),
            Signal::action(0, "force", "N"),
        ]
    }

    fn time_step(&self) -> Option<f64> {
        Some(DT)
    }

    /// The cart on its rail, for pictures of an episode; the arrow is the force.
    fn draw(&self, action: &[f64]) -> Option<Drawing> {
        let (x, force) = (self.x, action.first().copied().unwrap_or(0.0).clamp(-1.0, 1.0));
        let drawing = Drawing::new([-X - 0.4, -0.6], [X + 0.4, 0.9])
            .line(
                Class::Wall,
                &[[-X - 0.2, 0.3], [-X - 0.2, 0.0], [X + 0.2, 0.0], [X + 0.2, 0.3]],
            )
            .line(Class::Goal, &[[0.0, -0.1], [0.0, 0.1]])
            .rectangle(Class::Body, [x - 0.2, 0.0], [x + 0.2, 0.2]);
        Some(drawing.arrow(Class::Force, [x, 0.4], [x + 0.8 * force, 0.4]))
    }
}
