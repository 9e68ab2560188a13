//! The pendulum's swing-up.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};
use shoal_env_server::environment::angle::{unwrapped, wrap};

use super::{AT_REST, mean, round, tail};
use crate::evaluation::rollout::{Rollout, Trajectory};

/// The swing-up ends when the pendulum is nearer to upright than this, in rad.
const UP: f64 = 0.5;

/// An episode of T steps that starts hanging down at rest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SwingUp {
    /// θ in rad, T + 1 values without jumps. 0 and whole turns are upright.
    pub angle: Vec<f64>,
    /// θ̇ in rad/s, T + 1 values.
    pub velocity: Vec<f64>,
    /// τ in N m, T values.
    pub torque: Vec<f64>,
    /// T rewards.
    pub rewards: Vec<f64>,
}

/// The measured quantities of a swing-up.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measures {
    /// The sum of the rewards.
    pub episode_return: f64,
    /// How often the direction of rotation changed before the pendulum was up.
    pub reversals: u32,
    /// Greatest |θ| from upright at rest, in rad.
    pub angle_at_rest: f64,
    /// Greatest |θ̇| at rest, in rad/s.
    pub velocity_at_rest: f64,
    /// Mean |τ| at rest, in N m.
    pub torque_at_rest: f64,
    /// Mean |τ − τ of the previous step| at rest, in N m.
    pub chatter_at_rest: f64,
}

impl SwingUp {
    /// Runs the policy from rest at θ = π.
    pub fn run(rollout: &mut Rollout<'_>) -> anyhow::Result<Self> {
        Ok(Self::of(&rollout.episode_from(&[PI, 0.0])?, PI))
    }

    /// From observations (cos θ, sin θ, θ̇) that start at `theta`. The angle must change by less than π each step.
    pub fn of(trajectory: &Trajectory, theta: f64) -> Self {
        let observations = trajectory.observations.iter();
        let seen = observations.map(|o| f64::from(o[1]).atan2(o[0].into()));
        Self {
            angle: unwrapped(seen, theta),
            velocity: trajectory.observations.iter().map(|o| o[2].into()).collect(),
            torque: trajectory.actions.iter().map(|a| a[0].into()).collect(),
            rewards: trajectory.rewards.clone(),
        }
    }

    /// The episode with rounded numbers, for a smaller file.
    pub fn rounded(mut self) -> Self {
        for column in [&mut self.angle, &mut self.velocity, &mut self.torque, &mut self.rewards] {
            round(column);
        }
        self
    }

    /// Measures the episode.
    pub fn measures(&self) -> Measures {
        let greatest = |values: &[f64]| values.iter().fold(0.0, |most: f64, value| most.max(value.abs()));
        let from_upright: Vec<f64> = self.angle.iter().map(|angle| wrap(*angle)).collect();
        let up = from_upright.iter().position(|angle| angle.abs() < UP);
        let swinging = &self.velocity[..up.unwrap_or(self.velocity.len())];
        let torque: Vec<f64> = tail(&self.torque, AT_REST).iter().map(|torque| torque.abs()).collect();
        let changes: Vec<f64> = self.torque.windows(2).map(|pair| (pair[1] - pair[0]).abs()).collect();
        Measures {
            episode_return: self.rewards.iter().sum(),
            reversals: swinging.windows(2).filter(|pair| pair[0] * pair[1] < 0.0).count() as u32,
            angle_at_rest: greatest(tail(&from_upright, AT_REST)),
            velocity_at_rest: greatest(tail(&self.velocity, AT_REST)),
            torque_at_rest: mean(&torque),
            chatter_at_rest: mean(tail(&changes, AT_REST)),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use super::*;
    use crate::testing::swing;

    #[test]
    fn the_angle_is_continuous_over_whole_turns() {
        for direction in [1.0, -1.0] {
            let turning: Vec<f64> = (0..100).map(|t| PI + direction * 0.39 * f64::from(t)).collect();
            let seen = |theta: &f64| vec![theta.cos() as f32, theta.sin() as f32, 0.0];
            let trajectory = Trajectory {
                observations: turning.iter().map(seen).collect(),
                ..Trajectory::default()
            };
            for (found, expected) in SwingUp::of(&trajectory, PI).angle.iter().zip(&turning) {
                assert!((found - expected).abs() < 1e-5, "{found} for {expected}");
            }
        }
    }

    #[test]
    fn rest_is_measured_from_the_nearest_upright_angle() {
        let measures = swing(TAU - 0.05, 0.125).measures();
        assert!((measures.angle_at_rest - 0.05).abs() < 1e-9, "{measures:?}");
        assert_eq!(
            (
                measures.torque_at_rest,
                measures.chatter_at_rest,
                measures.velocity_at_rest
            ),
            (0.125, 0.25, 0.0)
        );
        assert!((1..=3).contains(&measures.reversals), "{measures:?}");
        assert_eq!(measures.episode_return, -200.0);
    }
}
