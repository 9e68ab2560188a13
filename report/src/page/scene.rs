//! What an environment's numbers mean to somebody who watches it: signals with names and units, and what to draw of them.

use serde::Serialize;
use shoal_common::config::Config;
use shoal_common::space::Space;
use shoal_env_server::environment::{cart_pole, frozen_lake, pendulum, point_mass};
use shoal_run::analysis::pendulum::SwingUp;
use shoal_run::rollout::Trajectory;

use super::numbers::short;

/// Numbers of an observation, and of an action, that are shown where nothing is known of them.
const SHOWN: usize = 8;

/// The picture of an environment, with what it needs besides the signals.
#[derive(Clone, Debug, Default, Serialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub(super) enum Scene {
    /// A rod that swings.
    Pendulum {
        /// Δt in s.
        dt: f64,
        /// Greatest torque in N m.
        torque: f64,
    },
    /// A vehicle on its way.
    PointMass {
        /// Δt in s.
        dt: f64,
        /// Walls at this |x| and |y|, in m.
        wall: f64,
        /// Greatest force in N.
        force: f64,
    },
    /// A pole on a cart.
    CartPole {
        /// Δt in s.
        dt: f64,
        /// The track's ends, in m.
        track: f64,
        /// The pole's length in m.
        pole: f64,
    },
    /// A walk over fields.
    FrozenLake {
        /// Row by row: S, F, H, G.
        map: String,
    },
    /// No picture: the signals alone.
    #[default]
    Lines,
}

/// A number that changes from picture to picture; NaN where it has no value.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Signal {
    pub(super) name: String,
    /// Empty for what is counted.
    pub(super) unit: &'static str,
    pub(super) values: Vec<f64>,
}

impl Scene {
    pub(super) fn of(config: &Config) -> Self {
        let greatest = |space: &Space, i: usize| match space {
            Space::Box { high, .. } => high.get(i).copied().map_or(1.0, f64::from),
            Space::Discrete { .. } => 1.0,
        };
        let spec = &config.spec;
        match config.environment.name.as_str() {
            "pendulum" => Self::Pendulum {
                dt: pendulum::DT,
                torque: greatest(&spec.action, 0),
            },
            "point-mass" => Self::PointMass {
                dt: point_mass::DT,
                wall: greatest(&spec.observation, 0),
                force: greatest(&spec.action, 1),
            },
            "cart-pole" => Self::CartPole {
                dt: cart_pole::DT,
                track: cart_pole::X_LIMIT,
                pole: 2.0 * cart_pole::L,
            },
            "frozen-lake" => Self::FrozenLake {
                map: frozen_lake::MAP.iter().map(|field| char::from(*field)).collect(),
            },
            _ => Self::Lines,
        }
    }

    /// The signals of an episode at these of its T + 1 states. An action belongs to the state that it is taken in, a
    /// reward to the one that it leads to.
    pub(super) fn signals(&self, trajectory: &Trajectory, frames: &[usize]) -> Vec<Signal> {
        let Trajectory {
            observations,
            actions,
            rewards,
            ..
        } = trajectory;
        let signal = |name: &str, unit, at: &dyn Fn(usize) -> Option<f64>| Signal {
            name: name.into(),
            unit,
            values: frames.iter().map(|t| short(at(*t).unwrap_or(f64::NAN))).collect(),
        };
        let seen = |i: usize| move |t: usize| Some(f64::from(*observations.get(t)?.get(i)?));
        let done = |i: usize| move |t: usize| Some(f64::from(*actions.get(t)?.get(i)?));
        let mut signals = match self {
            Self::Pendulum { .. } => {
                let first = observations.first().map_or(0.0, |o| f64::from(o[1]).atan2(o[0].into()));
                let angle = SwingUp::of(trajectory, first).angle;
                vec![
                    signal("angle from upright", "rad", &|t| angle.get(t).copied()),
                    signal("angular velocity", "rad/s", &seen(2)),
                    signal("torque", "N m", &done(0)),
                ]
            }
            Self::PointMass { .. } => vec![
                signal("x", "m", &seen(0)),
                signal("y", "m", &seen(1)),
                signal("distance to the goal", "m", &seen(4)),
                signal("force", "N", &done(1)),
                signal("direction of the force", "rad", &done(0)),
            ],
            Self::CartPole { .. } => vec![
                signal("position", "m", &seen(0)),
                signal("angle from upright", "rad", &seen(2)),
                signal("push (0 ←, 1 →)", "", &done(0)),
            ],
            Self::FrozenLake { .. } => vec![
                signal("field", "", &seen(0)),
                signal("direction meant (0 ←, 1 ↓, 2 →, 3 ↑)", "", &done(0)),
            ],
            Self::Lines => {
                let width = |rows: &[Vec<f32>]| rows.first().map_or(0, Vec::len).min(SHOWN);
                let observed =
                    (0..width(observations)).map(|i| signal(&format!("observation {}", i + 1), "", &seen(i)));
                let acted = (0..width(actions)).map(|i| signal(&format!("action {}", i + 1), "", &done(i)));
                observed.chain(acted).collect()
            }
        };
        let sums: Vec<f64> = rewards
            .iter()
            .scan(0.0, |sum, reward| {
                *sum += reward;
                Some(*sum)
            })
            .collect();
        let before = |values: &[f64], t: usize| t.checked_sub(1).and_then(|t| values.get(t).copied());
        signals.push(signal("reward", "", &|t| before(rewards, t)));
        signals.push(signal("return so far", "", &|t| before(&sums, t).or(Some(0.0))));
        signals
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_run::rollout::Rollout;
    use shoal_run::testing::small;

    #[test]
    fn actions_belong_to_the_state_they_are_taken_in_and_rewards_to_the_one_they_lead_to() {
        let trajectory = Trajectory {
            observations: vec![vec![0.0], vec![1.0], vec![2.0]],
            actions: vec![vec![5.0], vec![6.0]],
            rewards: vec![-1.0, -3.0],
            terminated: true,
        };
        let signals = Scene::Lines.signals(&trajectory, &[0, 1, 2]);
        let names: Vec<&str> = signals.iter().map(|signal| signal.name.as_str()).collect();
        assert_eq!(names, ["observation 1", "action 1", "reward", "return so far"]);
        assert_eq!(signals[0].values, [0.0, 1.0, 2.0]);
        assert_eq!(signals[1].values[..2], [5.0, 6.0]);
        assert!(signals[1].values[2].is_nan() && signals[2].values[0].is_nan());
        assert_eq!(signals[2].values[1..], [-1.0, -3.0]);
        assert_eq!(signals[3].values, [0.0, -1.0, -4.0]);
    }

    #[test]
    fn a_pendulum_that_hangs_is_half_a_turn_from_upright() {
        let (config, parameters) = small("name = \"pendulum\"\ntime_limit = 3");
        let mut rollout = Rollout::new(&config, &parameters).unwrap();
        let hanging = rollout.episode_from(&[std::f64::consts::PI, 0.0]).unwrap();
        let signals = Scene::of(&config).signals(&hanging, &[0, 3]);
        assert!(
            signals[0]
                .values
                .iter()
                .all(|angle| (angle.abs() - std::f64::consts::PI).abs() < 1e-3),
            "{signals:?}"
        );
    }

    #[test]
    fn the_vehicle_is_where_its_observation_says() {
        let (config, parameters) = small("name = \"point-mass\"\nreward = \"r3\"");
        let mut rollout = Rollout::new(&config, &parameters).unwrap();
        let drive = rollout.episode_from(&[1.5, -2.0, 0.0, 0.0]).unwrap();
        let signals = Scene::of(&config).signals(&drive, &[0]);
        let first: Vec<(&str, f64)> = signals.iter().map(|s| (s.name.as_str(), s.values[0])).take(3).collect();
        assert_eq!(first, [("x", 1.5), ("y", -2.0), ("distance to the goal", 2.5)]);
    }
}
