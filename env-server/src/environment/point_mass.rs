//! The point mass vehicle of section 5.1: a force with magnitude and direction against Coulomb friction with stiction.

mod parameters;
mod reward;

use std::f64::consts::PI;

pub use parameters::PointMassParameters;
use rand::RngExt;
pub use reward::{Motion, Reward, RewardTerms};
use shoal_base::{
    space::{EnvironmentSpec, Space},
    stream::Stream,
};

use super::{Class, Drawing, Environment, Goal, OutOfRange, Picture, RequestError, Signal, Step, angle::wrap};

/// Δt in s.
const DT: f64 = 0.05;
/// Walls at this |x| and |y|, in m.
const WALL: f64 = 4.0;
/// Greatest |ẋ| and |ẏ|, in m/s.
const MAX_SPEED: f64 = 1.0;
/// Greatest F_u, in N.
const MAX_FORCE: f64 = 2.0;
/// The goal is reached if d is below this at an episode's end, in m.
pub const REACHED: f64 = 0.05;

/// A vehicle on a plane whose goal is the origin. Observation (x̃, ỹ, ẋ, ẏ, d, ḋ) of equation (5.7), action (θ, F_u) of
/// equation (5.8) with θ in rad and F_u in N. Episodes start at rest and never terminate.
#[derive(Clone, Debug)]
pub struct PointMass {
    parameters: PointMassParameters,
    x: Axis,
    y: Axis,
    /// The previous action (θ, F_u); none before an episode's first step.
    previous_action: Option<(f64, f64)>,
}

/// The previous action in a saved state where there is none. A clipped action is never infinite.
const NO_ACTION: (f64, f64) = (f64::INFINITY, f64::INFINITY);

/// One coordinate's motion.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Axis {
    /// In m, within ±`WALL`.
    position: f64,
    /// In m/s, within ±`MAX_SPEED`; exactly 0 is at rest.
    velocity: f64,
}

impl Axis {
    /// Takes a step of explicit Euler (equations 5.4 and 5.5; the position changes by the velocity before the step)
    /// under the applied force `f`. Friction acts as equation (5.6) intends: it holds an axis at rest while |f| ≤
    /// `f_s`, never pushes it, and opposes the motion (at breakaway, the motion that begins) with `f_c`. A wall stops
    /// motion towards it.
    fn step(&mut self, f: f64, m: f64, f_c: f64, f_s: f64) {
        let v = self.velocity;
        let next = if v == 0.0 {
            if f.abs() <= f_s {
                0.0
            } else {
                DT / m * (f - f_c * f.signum())
            }
        } else {
            let next = v + DT / m * (f - f_c * v.signum());
            // Euler has stepped over ẋ = 0, where stiction would have held the axis.
            if next * v <= 0.0 && f.abs() <= f_s { 0.0 } else { next }
        };
        self.position += DT * v;
        self.velocity = next.clamp(-MAX_SPEED, MAX_SPEED);
        if self.position.abs() >= WALL {
            self.position = self.position.clamp(-WALL, WALL);
            if self.velocity * self.position > 0.0 {
                self.velocity = 0.0;
            }
        }
    }
}

impl PointMass {
    /// At rest at the goal.
    pub fn new(parameters: PointMassParameters) -> Result<Self, OutOfRange> {
        parameters.check()?;
        Ok(Self {
            parameters,
            x: Axis::default(),
            y: Axis::default(),
            previous_action: None,
        })
    }

    /// The distance to the goal, d, in m.
    fn d(&self) -> f64 {
        self.x.position.hypot(self.y.position)
    }

    /// ḋ in m/s; 0 at the goal, where it is undefined.
    fn d_dot(&self) -> f64 {
        let d = self.d();
        if d == 0.0 {
            return 0.0;
        }
        (self.x.position * self.x.velocity + self.y.position * self.y.velocity) / d
    }

    /// The signal of d.
    fn distance() -> Signal {
        Signal::observation(4, "distance", "m").label("distance to the goal")
    }

    /// x, y, ẋ, ẏ, and the previous action.
    fn saved(&self) -> [f64; 6] {
        let Self { x, y, .. } = self;
        let (theta, force) = self.previous_action.unwrap_or(NO_ACTION);
        [x.position, y.position, x.velocity, y.velocity, theta, force]
    }

    fn start(&mut self, x: Axis, y: Axis) {
        (self.x, self.y, self.previous_action) = (x, y, None);
    }
}

impl Environment for PointMass {
    /// The ranges of table 5.1.
    fn spec(&self) -> EnvironmentSpec {
        let (wall, speed) = ((-WALL as f32, WALL as f32), (-MAX_SPEED as f32, MAX_SPEED as f32));
        let any = (f32::NEG_INFINITY, f32::INFINITY);
        EnvironmentSpec {
            observation: Space::boxed(&[wall, wall, speed, speed, (-10.0, 10.0), any]),
            action: Space::boxed(&[(-PI as f32, PI as f32), (0.0, MAX_FORCE as f32)]),
            time_limit: self.parameters.time_limit,
            state_width: self.saved().len(),
        }
    }

    fn reset(&mut self, rng: &mut Stream) {
        let mut resting = || Axis {
            position: rng.random_range(-WALL..=WALL),
            velocity: 0.0,
        };
        let (x, y) = (resting(), resting());
        self.start(x, y);
    }

    fn reset_to(&mut self, state: &[f64]) -> Result<(), RequestError> {
        match *state {
            [x, y, x_dot, y_dot]
                if x.abs() <= WALL && y.abs() <= WALL && x_dot.abs() <= MAX_SPEED && y_dot.abs() <= MAX_SPEED =>
            {
                self.start(
                    Axis {
                        position: x,
                        velocity: x_dot,
                    },
                    Axis {
                        position: y,
                        velocity: y_dot,
                    },
                );
                Ok(())
            }
            _ => Err(RequestError::State {
                state: state.to_vec(),
                expected: "four numbers: x and y within -4 to 4 m, their velocities within -1 to 1 m/s",
            }),
        }
    }

    fn observe(&self, observation: &mut [f32]) {
        let Self { x, y, .. } = self;
        let observed = [x.position, y.position, x.velocity, y.velocity, self.d(), self.d_dot()];
        observation.copy_from_slice(&observed.map(|x| x as f32));
    }

    fn step(&mut self, action: &[f64], _: &mut Stream) -> Step {
        let (theta, force) = (action[0].clamp(-PI, PI), action[1].clamp(0.0, MAX_FORCE));
        let PointMassParameters {
            mass: m,
            friction: mu,
            gravity: g,
            stiction_ratio,
            goal_radius,
            reward,
            ..
        } = self.parameters;
        let f_c = mu * m * g;
        let f_s = stiction_ratio * f_c;
        self.x.step(force * theta.cos(), m, f_c, f_s);
        self.y.step(force * theta.sin(), m, f_c, f_s);
        let (theta_before, force_before) = self.previous_action.replace((theta, force)).unwrap_or((theta, force));
        let motion = Motion {
            d: self.d(),
            d_dot: self.d_dot(),
            theta_dot: wrap(theta - theta_before) / PI / DT,
            force,
            force_dot: (force - force_before) / DT,
        };
        Step {
            reward: reward.of(&motion, goal_radius),
            terminated: false,
        }
    }

    fn save(&self, state: &mut [f64]) {
        state.copy_from_slice(&self.saved());
    }

    /// Unlike `reset_to`, this also restores the previous action.
    fn restore(&mut self, state: &[f64]) -> Result<(), RequestError> {
        let previous_action = match *state {
            [_, _, _, _, theta, force] if (theta, force) == NO_ACTION => None,
            [_, _, _, _, theta, force] if theta.abs() <= PI && (0.0..=MAX_FORCE).contains(&force) => {
                Some((theta, force))
            }
            _ => {
                return Err(RequestError::State {
                    state: state.to_vec(),
                    expected: "six numbers: x and y, their velocities, and the previous action (infinity if none)",
                });
            }
        };
        self.reset_to(&state[..4])?;
        self.previous_action = previous_action;
        Ok(())
    }

    fn signals(&self) -> Vec<Signal> {
        vec![
            Signal::observation(0, "x", "m"),
            Signal::observation(1, "y", "m"),
            Self::distance(),
            Signal::action(1, "force", "N"),
            Signal::action(0, "direction", "rad").label("direction of the force"),
        ]
    }

    fn time_step(&self) -> Option<f64> {
        Some(DT)
    }

    fn goal(&self) -> Option<Goal> {
        Some(Goal {
            distance: Self::distance(),
            within: REACHED,
        })
    }

    /// The vehicle from above; the cross is the goal, the arrow the force.
    fn draw(&self, action: &[f64]) -> Option<Drawing> {
        let place = [self.x.position, self.y.position];
        let edge = 1.06 * WALL;
        let mut drawing = Drawing::new([-edge, -edge], [edge, edge]);
        for i in -3..=3 {
            let at = f64::from(i) * WALL / 4.0;
            drawing = drawing
                .line(Class::Guide, &[[at, -WALL], [at, WALL]])
                .line(Class::Guide, &[[-WALL, at], [WALL, at]]);
        }
        let outline = [
            [-WALL, -WALL],
            [WALL, -WALL],
            [WALL, WALL],
            [-WALL, WALL],
            [-WALL, -WALL],
        ];
        let drawing = drawing
            .line(Class::Wall, &outline)
            .text([-0.97 * WALL, 0.92 * WALL], &format!("walls at ±{WALL} m"))
            .line(Class::Goal, &[[-0.16, 0.0], [0.16, 0.0]])
            .line(Class::Goal, &[[0.0, -0.16], [0.0, 0.16]])
            .text([0.2, -0.35], "goal")
            .circle(Class::Body, place, 0.045 * WALL)
            .trail(place);
        Some(match *action {
            [theta, force] => {
                let length = 0.3 * WALL * (force / MAX_FORCE).clamp(0.0, 1.0);
                let tip = [place[0] + length * theta.cos(), place[1] + length * theta.sin()];
                drawing.arrow(Class::Force, place, tip)
            }
            _ => drawing,
        })
    }

    fn picture(&self) -> Picture {
        Picture::Plane
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;
    use shoal_base::stream::{Purpose, stream};

    /// F_c of these tests' vehicle: μ m g.
    const F_C: f64 = 0.02 * 9.81;
    const F_S: f64 = 1.2 * F_C;

    fn at(parameters: &str, state: [f64; 4]) -> PointMass {
        let mut vehicle = PointMass::new(toml::from_str(&format!("friction = 0.02\n{parameters}")).unwrap()).unwrap();
        vehicle.reset_to(&state).unwrap();
        vehicle
    }

    fn state(vehicle: &PointMass) -> [f64; 4] {
        [
            vehicle.x.position,
            vehicle.y.position,
            vehicle.x.velocity,
            vehicle.y.velocity,
        ]
    }

    fn rng() -> Stream {
        stream(0, Purpose::Environment, 0, 0)
    }

    fn step(vehicle: &mut PointMass, theta: f64, force: f64) -> f64 {
        vehicle.step(&[theta, force], &mut rng()).reward
    }

    fn assert_near(ours: [f64; 4], by_hand: [f64; 4]) {
        assert!(
            ours.iter().zip(by_hand).all(|(a, b)| (a - b).abs() < 1e-12),
            "{ours:?}, by hand {by_hand:?}"
        );
    }

    #[test]
    fn a_force_up_to_stiction_never_moves_a_resting_vehicle() {
        for theta in [0.0, FRAC_PI_2, PI, -2.5, 0.7] {
            let mut vehicle = at("", [1.0, -1.0, 0.0, 0.0]);
            for _ in 0..100 {
                step(&mut vehicle, theta, F_S);
            }
            assert_eq!(state(&vehicle), [1.0, -1.0, 0.0, 0.0], "θ = {theta}");
        }
    }

    #[test]
    fn beyond_stiction_it_breaks_away_against_coulomb_friction() {
        let mut vehicle = at("", [1.0, -1.0, 0.0, 0.0]);
        step(&mut vehicle, PI, F_S + 0.01);
        assert_near(state(&vehicle), [1.0, -1.0, -0.05 * (F_S + 0.01 - F_C), 0.0]);
    }

    #[test]
    fn euler_moves_the_position_by_the_old_velocity() {
        let mut vehicle = at("mass = 2.0", [0.0, 0.0, 0.5, -0.5]);
        step(&mut vehicle, FRAC_PI_2, 2.0);
        let f_c = 2.0 * F_C;
        assert_near(
            state(&vehicle),
            [0.025, -0.025, 0.5 - 0.025 * f_c, -0.5 + 0.025 * (2.0 + f_c)],
        );
    }

    #[test]
    fn friction_stops_a_sliding_vehicle_and_never_pushes_it() {
        let mut vehicle = at("", [0.0, 0.0, 0.7, -0.3]);
        let mut before = state(&vehicle);
        for _ in 0..100 {
            step(&mut vehicle, 0.0, 0.0);
            let now = state(&vehicle);
            assert!(
                (0.0..=before[2]).contains(&now[2]) && (before[3]..=0.0).contains(&now[3]),
                "{before:?} {now:?}"
            );
            before = now;
        }
        assert_eq!(before[2..], [0.0, 0.0]);
        // Sliding from 0.7 m/s to rest takes 0.7² / (2 μ g) m, apart from half of Euler's first step.
        assert!((before[0] - 0.49 / (2.0 * F_C)).abs() < 0.02, "{before:?}");
        step(&mut vehicle, 0.3, 0.9 * F_S);
        assert_eq!(state(&vehicle), before);
    }

    #[test]
    fn a_force_beyond_stiction_reverses_the_motion_without_a_stop() {
        let mut vehicle = at("", [0.0, 0.0, 0.01, 0.0]);
        step(&mut vehicle, PI, 1.0);
        assert_near(state(&vehicle), [0.0005, 0.0, 0.01 - 0.05 * (1.0 + F_C), 0.0]);
        let mut held = at("", [0.0, 0.0, 0.01, 0.0]);
        step(&mut held, PI, F_S);
        assert_eq!(held.x.velocity, 0.0);
    }

    #[test]
    fn velocity_is_clipped_and_a_wall_stops_only_its_axis() {
        let mut vehicle = at("", [3.0, 0.0, 0.99, 0.0]);
        step(&mut vehicle, 0.25 * PI, 2.0);
        assert_eq!(vehicle.x.velocity, 1.0);
        for _ in 0..40 {
            step(&mut vehicle, 0.25 * PI, 2.0);
        }
        assert_eq!(
            vehicle.x,
            Axis {
                position: 4.0,
                velocity: 0.0
            }
        );
        assert!(vehicle.y.position > 1.0 && vehicle.y.velocity == 1.0);
        for _ in 0..2 {
            step(&mut vehicle, PI, 2.0);
        }
        assert!(
            vehicle.x.position < 4.0 && vehicle.x.velocity < 0.0,
            "a wall does not hold a vehicle that leaves it"
        );
    }

    #[test]
    fn directions_on_either_side_of_pi_are_close() {
        // d_dot is 0 at rest, so only the θ̇ and force terms of r2 remain.
        let reward = |first, second| {
            let mut vehicle = at("reward = 'r2'\nc_force_dot = 0.01", [1.0, 1.0, 0.0, 0.0]);
            assert_eq!(step(&mut vehicle, first, 0.1), 0.0, "no θ̇ and no Ḟ on the first step");
            step(&mut vehicle, second, 0.15)
        };
        assert!((reward(PI, -PI) - -0.01).abs() < 1e-12);
        assert!((reward(3.0, -3.0) - (-0.01 - 0.0015 * ((2.0 * PI - 6.0) / PI * 20.0).powi(2))).abs() < 1e-12);
        assert!(
            (reward(0.0, PI) - (-0.01 - 0.6)).abs() < 1e-12,
            "the thesis's greatest penalty"
        );
        let mut vehicle = at("reward = 'r3'", [1.0, 1.0, 0.0, 0.0]);
        step(&mut vehicle, 3.0, 0.0);
        vehicle.reset_to(&[1.0, 1.0, 0.0, 0.0]).unwrap();
        assert_eq!(
            step(&mut vehicle, -1.0, 0.0),
            0.0,
            "a new episode has no previous direction"
        );
    }

    #[test]
    fn the_reward_uses_the_state_after_the_step() {
        let mut vehicle = at("reward = 'r3'", [0.3, -0.4, -0.6, 0.8]);
        let (x, y, x_dot, y_dot): (f64, f64, f64, f64) = (0.27, -0.36, -0.6 + 0.05 * F_C, 0.8 - 0.05 * (F_C + 2.0));
        let d_dot = (x * x_dot + y * y_dot) / x.hypot(y);
        let reward = step(&mut vehicle, -FRAC_PI_2, 7.0);
        assert!(
            (reward - (-0.03 * 4.0 - 0.5f64.sqrt() * d_dot)).abs() < 1e-12,
            "the force is clipped to 2 N"
        );
        let mut observation = [0.0; 6];
        vehicle.observe(&mut observation);
        assert_eq!(observation, [x, y, x_dot, y_dot, 0.45, d_dot].map(|x| x as f32));
        let mut arriving = at("reward = 'r1'", [0.06, 0.0, -0.5, 0.0]);
        assert!(
            step(&mut arriving, 0.0, 0.0) > 1.9,
            "within the goal radius after the step"
        );
        assert_eq!(at("", [0.0; 4]).d_dot(), 0.0);
    }

    #[test]
    fn episodes_start_at_rest_anywhere_and_impossible_states_are_refused() {
        let mut vehicle = at("", [0.0; 4]);
        let (mut rng, mut furthest) = (rng(), [0.0f64; 2]);
        for _ in 0..1000 {
            vehicle.reset(&mut rng);
            let [x, y, x_dot, y_dot] = state(&vehicle);
            furthest = [furthest[0].max(x.abs()), furthest[1].max(y.abs())];
            assert!(x.abs() <= 4.0 && y.abs() <= 4.0 && x_dot == 0.0 && y_dot == 0.0);
        }
        assert!(furthest.iter().all(|f| *f > 3.9));
        for bad in [
            &[0.0; 3][..],
            &[4.1, 0.0, 0.0, 0.0],
            &[0.0, 0.0, 0.0, -1.1],
            &[f64::NAN, 0.0, 0.0, 0.0],
        ] {
            assert!(vehicle.reset_to(bad).is_err(), "{bad:?}");
        }
    }
}
