//! The inverted pendulum of section 4.3: Gymnasium's Pendulum-v1.

use std::f64::consts::PI;

use rand::RngExt;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use shoal_base::{
    space::{EnvironmentSpec, Space},
    stream::Stream,
};

use super::{
    Class, Drawing, Environment, OutOfRange, Picture, RequestError, Signal, Step, angle::wrap, check, check_time_limit,
};

/// Δt in s.
pub const DT: f64 = 0.05;
/// Gravity in m/s², as Gymnasium rounds it.
const G: f64 = 10.0;
/// Mass in kg.
const M: f64 = 1.0;
/// Length in m.
const L: f64 = 1.0;
/// Greatest |θ̇| in rad/s.
const MAX_SPEED: f64 = 8.0;
/// Greatest |τ| in N m.
const MAX_TORQUE: f64 = 2.0;

/// Parameters of the pendulum.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PendulumParameters {
    /// Episodes start with |θ̇| up to this, in rad/s. The default of 2 is the thesis's; Gymnasium's is 1.
    #[schemars(extend("unit" = "rad/s", "source" = "section 4.3"))]
    pub start_speed: f64,
    /// Steps after which an episode is truncated.
    #[schemars(extend("unit" = "steps", "source" = "section 4.3"))]
    pub time_limit: u32,
}

impl Default for PendulumParameters {
    fn default() -> Self {
        Self {
            start_speed: 2.0,
            time_limit: 200,
        }
    }
}

/// A rod on a joint, driven by a torque τ; θ = 0 is upright. Observation (cos θ, sin θ, θ̇), action (τ). It never
/// terminates.
#[derive(Clone, Debug)]
pub struct Pendulum {
    parameters: PendulumParameters,
    /// θ in rad, not wrapped, as in Gymnasium.
    theta: f64,
    /// θ̇ in rad/s.
    theta_dot: f64,
}

impl Pendulum {
    /// Upright and at rest.
    pub fn new(parameters: PendulumParameters) -> Result<Self, OutOfRange> {
        check("start_speed", parameters.start_speed, 0.0..=MAX_SPEED)?;
        check_time_limit(parameters.time_limit)?;
        Ok(Self {
            parameters,
            theta: 0.0,
            theta_dot: 0.0,
        })
    }

    /// The physical state (θ, θ̇) in rad and rad/s, as `reset_to` takes it; θ counts whole turns.
    pub fn state(&self) -> [f64; 2] {
        [self.theta, self.theta_dot]
    }
}

impl Environment for Pendulum {
    fn spec(&self) -> EnvironmentSpec {
        let (speed, torque) = (MAX_SPEED as f32, MAX_TORQUE as f32);
        EnvironmentSpec {
            observation: Space::boxed(&[(-1.0, 1.0), (-1.0, 1.0), (-speed, speed)]),
            action: Space::boxed(&[(-torque, torque)]),
            time_limit: self.parameters.time_limit,
            state_width: self.state().len(),
        }
    }

    fn reset(&mut self, rng: &mut Stream) {
        let speed = self.parameters.start_speed;
        self.theta = rng.random_range(-PI..=PI);
        self.theta_dot = rng.random_range(-speed..=speed);
    }

    fn reset_to(&mut self, state: &[f64]) -> Result<(), RequestError> {
        match *state {
            [theta, theta_dot] if theta.is_finite() && theta_dot.abs() <= MAX_SPEED => {
                (self.theta, self.theta_dot) = (theta, theta_dot);
                Ok(())
            }
            _ => Err(RequestError::State {
                state: state.to_vec(),
                expected: "two numbers: the angle in rad, and the angular velocity within -8 to 8 rad/s",
            }),
        }
    }

    fn observe(&self, observation: &mut [f32]) {
        let observed = [self.theta.cos(), self.theta.sin(), self.theta_dot];
        observation.copy_from_slice(&observed.map(|x| x as f32));
    }

    /// Equation (4.2) for the state *before* the step, as in Gymnasium, then semi-implicit Euler.
    fn step(&mut self, action: &[f64], _: &mut Stream) -> Step {
        let tau = action[0].clamp(-MAX_TORQUE, MAX_TORQUE);
        let reward = -(wrap(self.theta).powi(2) + 0.1 * self.theta_dot.powi(2) + 0.001 * tau.powi(2));
        let theta_ddot = 3.0 * G / (2.0 * L) * self.theta.sin() + 3.0 / (M * L * L) * tau;
        self.theta_dot = (self.theta_dot + theta_ddot * DT).clamp(-MAX_SPEED, MAX_SPEED);
        self.theta += self.theta_dot * DT;
        Step {
            reward,
            terminated: false,
        }
    }

    fn save(&self, state: &mut [f64]) {
        state.copy_from_slice(&self.state());
    }

    fn signals(&self) -> Vec<Signal> {
        vec![
            Signal::angle(0, 1, "angle").label("angle from upright"),
            Signal::observation(2, "angular-velocity", "rad/s").label("angular velocity"),
            Signal::action(0, "torque", "N m"),
        ]
    }

    fn time_step(&self) -> Option<f64> {
        Some(DT)
    }

    /// The rod on its joint; the arc at the joint is the torque.
    fn draw(&self, action: &[f64]) -> Option<Drawing> {
        // Upright is 0; angles grow counterclockwise.
        let at = |angle: f64, radius: f64| [-radius * angle.sin(), radius * angle.cos()];
        let bob = at(self.theta, L);
        let drawing = Drawing::new([-1.6, -1.4], [1.6, 1.4])
            .circle(Class::Guide, [0.0, 0.0], L)
            .line(Class::Guide, &[[0.0, 1.05 * L], [0.0, 1.2 * L]])
            .line(Class::Rod, &[[0.0, 0.0], bob])
            .circle(Class::Body, bob, 0.11);
        let turn = 2.4
            * action
                .first()
                .map_or(0.0, |torque| (torque / MAX_TORQUE).clamp(-1.0, 1.0));
        let drawing = if turn.abs() < 0.05 {
            drawing
        } else {
            let arc: Vec<_> = (0..=12).map(|i| at(turn * f64::from(i) / 12.0, 0.32)).collect();
            drawing.line(Class::Force, &arc).arrow(Class::Force, arc[11], arc[12])
        };
        Some(drawing.circle(Class::Joint, [0.0, 0.0], 0.05))
    }

    fn picture(&self) -> Picture {
        Picture::Rod
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_base::stream::{Purpose, stream};

    fn at(theta: f64, theta_dot: f64) -> Pendulum {
        let mut pendulum = Pendulum::new(PendulumParameters::default()).unwrap();
        pendulum.reset_to(&[theta, theta_dot]).unwrap();
        pendulum
    }

    fn rng() -> Stream {
        stream(0, Purpose::Environment, 0, 0)
    }

    #[test]
    fn the_reward_is_equation_4_2_before_the_step() {
        let reward = |theta, theta_dot, tau| at(theta, theta_dot).step(&[tau], &mut rng()).reward;
        assert!((reward(0.5, -2.0, 1.5) - -(0.25 + 0.4 + 0.00225)).abs() < 1e-12);
        assert!((reward(0.5 + 4.0 * PI, -2.0, 1.5) - -(0.25 + 0.4 + 0.00225)).abs() < 1e-12);
        assert!(
            (reward(PI, 8.0, 5.0) - -16.2736).abs() < 1e-4,
            "the thesis's lowest reward"
        );
        assert_eq!(reward(0.0, 0.0, 0.0), 0.0);
    }

    #[test]
    fn gravity_pulls_away_from_upright_and_torque_pushes() {
        let mut pendulum = at(0.1, 0.0);
        pendulum.step(&[0.0], &mut rng());
        assert!((pendulum.theta_dot - 0.75 * 0.1f64.sin()).abs() < 1e-12);
        assert!((pendulum.theta - (0.1 + 0.05 * pendulum.theta_dot)).abs() < 1e-12);
        let mut pushed = at(0.0, 0.0);
        pushed.step(&[2.0], &mut rng());
        assert!((pushed.theta_dot - 0.3).abs() < 1e-12);
    }

    #[test]
    fn start_states_fill_exactly_their_range() {
        let parameters = PendulumParameters {
            start_speed: 0.5,
            ..PendulumParameters::default()
        };
        let mut pendulum = Pendulum::new(parameters).unwrap();
        let mut rng = rng();
        let starts: Vec<_> = (0..1000)
            .map(|_| {
                pendulum.reset(&mut rng);
                pendulum.state()
            })
            .collect();
        let extent = |i: usize| starts.iter().map(|s| s[i].abs()).fold(0.0, f64::max);
        assert!((0.99 * PI..=PI).contains(&extent(0)) && (0.495..=0.5).contains(&extent(1)));
    }

    #[test]
    fn impossible_states_are_refused() {
        let mut pendulum = at(0.2, 0.3);
        for state in [&[0.0][..], &[0.0, 0.0, 0.0], &[f64::NAN, 0.0], &[0.0, 9.0]] {
            let message = pendulum.reset_to(state).unwrap_err().to_string();
            assert!(message.contains("two numbers"), "{message}");
        }
        assert_eq!(pendulum.state(), [0.2, 0.3]);
    }
}
