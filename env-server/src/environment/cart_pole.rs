//! The pole on a cart of section 4.2: Gymnasium's CartPole-v1, with the thesis's time limit.

use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::{
    space::{EnvironmentSpec, Space},
    stream::Stream,
};

use super::{Class, Drawing, Environment, OutOfRange, Picture, RequestError, Signal, Step, check_time_limit};

/// Gravity in m/s².
const G: f64 = 9.8;
/// Mass of the cart in kg.
const M_CART: f64 = 1.0;
/// Mass of the pole in kg.
const M_POLE: f64 = 0.1;
/// Half the pole's length in m.
const L: f64 = 0.5;
/// Size of the push in N.
const FORCE: f64 = 10.0;
/// Δt in s.
const DT: f64 = 0.02;
/// The cart leaves the track beyond this |x|, in m.
const X_LIMIT: f64 = 2.4;
/// The pole has fallen beyond this |θ|: 12° in rad. (The thesis's table shows twice this, the observation's range.)
const THETA_LIMIT: f64 = 12.0 / 180.0 * std::f64::consts::PI;

/// Parameters of the cart with the pole.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct CartPoleParameters {
    /// Steps after which an episode is truncated.
    #[schemars(extend("unit" = "steps", "source" = "section 4.2.1"))]
    pub time_limit: u32,
}

impl Default for CartPoleParameters {
    fn default() -> Self {
        Self { time_limit: 200 }
    }
}

/// A pole on a cart that must be kept upright. Observation (x, ẋ, θ, θ̇), action 0 (push left) or 1 (push right),
/// reward 1 per step. It terminates when the pole has fallen or the cart has left the track.
#[derive(Clone, Debug)]
pub struct CartPole {
    parameters: CartPoleParameters,
    /// (x, ẋ, θ, θ̇) in m, m/s, rad, rad/s.
    state: [f64; 4],
}

impl CartPole {
    /// Upright, centred and at rest.
    pub fn new(parameters: CartPoleParameters) -> Result<Self, OutOfRange> {
        check_time_limit(parameters.time_limit)?;
        Ok(Self {
            parameters,
            state: [0.0; 4],
        })
    }
}

impl Environment for CartPole {
    fn spec(&self) -> EnvironmentSpec {
        let (x, theta) = (2.0 * X_LIMIT as f32, 2.0 * THETA_LIMIT as f32);
        let any = (f32::NEG_INFINITY, f32::INFINITY);
        EnvironmentSpec {
            observation: Space::boxed(&[(-x, x), any, (-theta, theta), any]),
            action: Space::discrete(2),
            time_limit: self.parameters.time_limit,
            state_width: self.state.len(),
        }
    }

    fn reset(&mut self, rng: &mut Stream) {
        self.state = std::array::from_fn(|_| rng.random_range(-0.05..=0.05));
    }

    fn reset_to(&mut self, state: &[f64]) -> Result<(), RequestError> {
        match *state {
            [x, x_dot, theta, theta_dot] if state.iter().all(|s| s.is_finite()) => {
                self.state = [x, x_dot, theta, theta_dot];
                Ok(())
            }
            _ => Err(RequestError::State {
                state: state.to_vec(),
                expected: "four finite numbers: position in m, velocity in m/s, angle in rad, angular velocity in rad/s",
            }),
        }
    }

    fn observe(&self, observation: &mut [f32]) {
        observation.copy_from_slice(&self.state.map(|x| x as f32));
    }

    /// Gymnasium's equations of motion (after Florian, "Correct equations for the dynamics of the cart-pole system"),
    /// integrated by explicit Euler as there.
    fn step(&mut self, action: &[f64], _: &mut Stream) -> Step {
        let [x, x_dot, theta, theta_dot] = self.state;
        let force = if action[0] < 0.5 { -FORCE } else { FORCE };
        let (sin, cos) = theta.sin_cos();
        let mass = M_CART + M_POLE;
        let push = (force + M_POLE * L * theta_dot.powi(2) * sin) / mass;
        let theta_ddot = (G * sin - cos * push) / (L * (4.0 / 3.0 - M_POLE * cos.powi(2) / mass));
        let x_ddot = push - M_POLE * L * theta_ddot * cos / mass;
        self.state = [
            x + DT * x_dot,
            x_dot + DT * x_ddot,
            theta + DT * theta_dot,
            theta_dot + DT * theta_ddot,
        ];
        let terminated = self.state[0].abs() > X_LIMIT || self.state[2].abs() > THETA_LIMIT;
        Step {
            reward: 1.0,
            terminated,
        }
    }

    fn save(&self, state: &mut [f64]) {
        state.copy_from_slice(&self.state);
    }

    fn signals(&self) -> Vec<Signal> {
        vec![
            Signal::observation(0, "position", "m"),
            Signal::observation(2, "angle", "rad").label("angle from upright"),
            Signal::action(0, "push", "").label("push (0 ←, 1 →)"),
        ]
    }

    fn time_step(&self) -> Option<f64> {
        Some(DT)
    }

    /// The cart on its track; the arrow is the push.
    fn draw(&self, action: &[f64]) -> Option<Drawing> {
        let [x, _, theta, _] = self.state;
        let (half, top) = (0.25, 0.26);
        let tip = [x + 2.0 * L * theta.sin(), top + 2.0 * L * theta.cos()];
        let end = |x: f64| [[x, -0.12], [x, 0.12]];
        let drawing = Drawing::new([-X_LIMIT - 0.3, -0.5], [X_LIMIT + 0.3, 1.7])
            .line(Class::Wall, &[[-X_LIMIT, 0.0], [X_LIMIT, 0.0]])
            .line(Class::Wall, &end(-X_LIMIT))
            .line(Class::Wall, &end(X_LIMIT))
            .rectangle(Class::Ground, [x - half, 0.0], [x + half, top])
            .line(Class::Rod, &[[x, top], tip])
            .circle(Class::Body, tip, 0.07);
        Some(match action.first() {
            Some(push) => {
                let side = if *push < 0.5 { -1.0 } else { 1.0 };
                drawing.arrow(Class::Force, [x + 0.27 * side, 0.13], [x + 0.67 * side, 0.13])
            }
            None => drawing,
        })
    }

    fn picture(&self) -> Picture {
        Picture::Cart {
            track: X_LIMIT,
            pole: 2.0 * L,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_base::stream::{Purpose, stream};

    fn at(state: [f64; 4]) -> CartPole {
        let mut cart_pole = CartPole::new(CartPoleParameters::default()).unwrap();
        cart_pole.reset_to(&state).unwrap();
        cart_pole
    }

    fn rng() -> Stream {
        stream(0, Purpose::Environment, 0, 0)
    }

    #[test]
    fn a_push_moves_the_cart_one_way_and_tips_the_pole_the_other() {
        for (action, sign) in [(0.0, -1.0), (1.0, 1.0)] {
            let mut cart_pole = at([0.0; 4]);
            assert_eq!(
                cart_pole.step(&[action], &mut rng()),
                Step {
                    reward: 1.0,
                    terminated: false
                }
            );
            // By hand: push = 10 / 1.1, θ̈ = −push / (0.5 (4/3 − 0.1/1.1)), ẍ = push + 0.05 |θ̈| / 1.1.
            let theta_ddot = 10.0 / 1.1 / (0.5 * (4.0 / 3.0 - 0.1 / 1.1));
            let x_ddot = 10.0 / 1.1 + 0.05 * theta_ddot / 1.1;
            let by_hand = [0.0, sign * 0.02 * x_ddot, 0.0, -sign * 0.02 * theta_ddot];
            for (ours, hand) in cart_pole.state.iter().zip(by_hand) {
                assert!((ours - hand).abs() < 1e-12, "{:?} {by_hand:?}", cart_pole.state);
            }
        }
    }

    #[test]
    fn falling_and_leaving_the_track_terminate() {
        for (state, terminated) in [
            ([0.0, 0.0, 0.20, 0.0], false),
            ([0.0, 0.0, 0.20, 0.6], true),
            ([0.0, 0.0, -0.20, -0.6], true),
            ([2.39, 0.4, 0.0, 0.0], false),
            ([2.39, 0.6, 0.0, 0.0], true),
            ([-2.39, -0.6, 0.0, 0.0], true),
        ] {
            assert_eq!(
                at(state).step(&[1.0], &mut rng()),
                Step {
                    reward: 1.0,
                    terminated
                },
                "{state:?}"
            );
        }
    }

    #[test]
    fn starts_are_small_and_states_have_four_numbers() {
        let mut cart_pole = at([0.0; 4]);
        cart_pole.reset(&mut rng());
        assert!(cart_pole.state.iter().all(|x| x.abs() <= 0.05 && *x != 0.0));
        assert!(cart_pole.reset_to(&[0.0; 3]).is_err());
        assert!(cart_pole.reset_to(&[0.0, 0.0, f64::INFINITY, 0.0]).is_err());
    }
}
