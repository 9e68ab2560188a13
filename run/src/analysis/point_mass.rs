//! The vehicle's drive to the goal.

use serde::{Deserialize, Serialize};
use shoal_env_server::environment::angle::wrap;
pub use shoal_env_server::environment::point_mass::REACHED;

use super::{AT_REST, mean, round, tail};
use crate::rollout::{Rollout, Trajectory};

/// Start positions of the thesis's section 5.3, (x, y) in m.
pub const NEAR_STARTS: [[f64; 2]; 4] = [[2.0, -2.0], [-2.0, 2.0], [2.0, 2.0], [-2.0, -2.0]];
/// Start positions of the thesis's appendix A.2, (x, y) in m, in its order.
pub const FAR_STARTS: [[f64; 2]; 8] = [
    [3.0, 3.0],
    [3.0, 0.0],
    [3.0, -3.0],
    [0.0, -3.0],
    [-3.0, -3.0],
    [-3.0, 0.0],
    [-3.0, 3.0],
    [0.0, 3.0],
];

/// An episode of T steps from a chosen start position, at rest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Drive {
    /// (x, y) in m; the goal is the origin.
    pub start: [f64; 2],
    /// x in m, T + 1 of them.
    pub x: Vec<f64>,
    /// y in m, T + 1 of them.
    pub y: Vec<f64>,
    /// θ in rad, one for each step.
    pub direction: Vec<f64>,
    /// F_u in N, one for each step.
    pub force: Vec<f64>,
    /// One for each step.
    pub rewards: Vec<f64>,
}

/// What is measured of a drive.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measures {
    /// (x, y) in m; the goal is the origin.
    pub start: [f64; 2],
    /// The sum of the rewards.
    pub episode_return: f64,
    /// d at the end, in m.
    pub final_distance: f64,
    /// How far apart the least and the greatest d at rest are, in m.
    pub drift_at_rest: f64,
    /// Σ |Δθ| over the whole episode, in rad.
    pub turning: f64,
    /// Σ |Δθ| over its second half, in rad.
    pub turning_second_half: f64,
    /// Σ |Δθ| at rest, in rad.
    pub turning_at_rest: f64,
    /// Mean F_u until the goal is reached, or over the whole episode, in N.
    pub force_on_the_way: f64,
    /// Mean F_u at rest, in N.
    pub force_at_rest: f64,
}

impl Drive {
    /// Runs the policy from rest at each of these places.
    pub fn run_from(rollout: &mut Rollout<'_>, starts: &[[f64; 2]]) -> anyhow::Result<Vec<Self>> {
        let run = |&[x, y]: &[f64; 2]| Ok(Self::of([x, y], &rollout.episode_from(&[x, y, 0.0, 0.0])?));
        starts.iter().map(run).collect()
    }

    /// From observations that begin with (x, y) and actions (θ, F_u).
    pub fn of(start: [f64; 2], trajectory: &Trajectory) -> Self {
        let column = |rows: &[Vec<f32>], i: usize| rows.iter().map(|row| row[i].into()).collect();
        Self {
            start,
            x: column(&trajectory.observations, 0),
            y: column(&trajectory.observations, 1),
            direction: column(&trajectory.actions, 0),
            force: column(&trajectory.actions, 1),
            rewards: trajectory.rewards.clone(),
        }
    }

    /// With numbers that are short to write.
    pub fn rounded(mut self) -> Self {
        for column in [
            &mut self.x,
            &mut self.y,
            &mut self.direction,
            &mut self.force,
            &mut self.rewards,
        ] {
            round(column);
        }
        self
    }

    /// T.
    pub fn steps(&self) -> usize {
        self.force.len()
    }

    /// The places (x, y) on the way.
    pub fn path(&self) -> impl Iterator<Item = (f64, f64)> {
        self.x.iter().copied().zip(self.y.iter().copied())
    }

    /// d at each of them.
    pub fn distances(&self) -> impl Iterator<Item = f64> {
        self.path().map(|(x, y)| x.hypot(y))
    }

    /// d at the end, in m.
    pub fn final_distance(&self) -> f64 {
        self.distances().last().unwrap_or(f64::NAN)
    }

    /// The sum of the rewards.
    pub fn episode_return(&self) -> f64 {
        self.rewards.iter().sum()
    }

    /// Measures the episode.
    pub fn measures(&self) -> Measures {
        let distances: Vec<f64> = self.distances().collect();
        let turns: Vec<f64> = self
            .direction
            .windows(2)
            .map(|pair| wrap(pair[1] - pair[0]).abs())
            .collect();
        let at_rest = tail(&distances, AT_REST);
        let (least, greatest) = at_rest.iter().fold((f64::INFINITY, 0.0), |(low, high): (f64, f64), d| {
            (low.min(*d), high.max(*d))
        });
        let on_the_way = distances.iter().position(|d| *d < REACHED).unwrap_or(self.steps());
        Measures {
            start: self.start,
            episode_return: self.episode_return(),
            final_distance: self.final_distance(),
            drift_at_rest: greatest - least,
            turning: turns.iter().sum(),
            turning_second_half: tail(&turns, self.steps() / 2).iter().sum(),
            turning_at_rest: tail(&turns, AT_REST).iter().sum(),
            force_on_the_way: mean(&self.force[..on_the_way.min(self.steps())]),
            force_at_rest: mean(tail(&self.force, AT_REST)),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::testing::drive;

    #[test]
    fn a_drive_is_measured() {
        let measures = drive([2.0, -2.0], 0.03, 0.25, 1.5, 0.5).measures();
        assert!((measures.final_distance - 0.03).abs() < 1e-9, "{measures:?}");
        // Across the jump from π to −π the turn is still a small one.
        assert!((measures.turning - 199.0 * 0.25).abs() < 1e-9, "{measures:?}");
        assert!(
            (measures.turning_second_half - 100.0 * 0.25).abs() < 1e-9,
            "{measures:?}"
        );
        assert!((measures.turning_at_rest - 50.0 * 0.25).abs() < 1e-9, "{measures:?}");
        assert_eq!((measures.force_on_the_way, measures.force_at_rest), (1.5, 0.5));
        assert!(measures.drift_at_rest < 1e-9 && measures.episode_return == 100.0);
    }

    #[test]
    fn who_never_arrives_is_on_the_way_all_the_time() {
        let measures = drive([3.0, 0.0], 1.0, 0.0, 2.0, 1.0).measures();
        assert!((measures.force_on_the_way - (80.0 * 2.0 + 120.0) / 200.0).abs() < 1e-9);
    }
}
