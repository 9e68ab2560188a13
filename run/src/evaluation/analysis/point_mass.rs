//! The vehicle's test runs: episodes from chosen positions to the goal.

use serde::{Deserialize, Serialize};
use shoal_env_server::environment::angle::wrap;
pub use shoal_env_server::environment::point_mass::REACHED;

use super::{AT_REST, mean, round, tail};
use crate::evaluation::rollout::{Rollout, Trajectory};

/// Start positions in section 5.3 of the thesis, (x, y) in m.
pub const NEAR_STARTS: [[f64; 2]; 4] = [[2.0, -2.0], [-2.0, 2.0], [2.0, 2.0], [-2.0, -2.0]];
/// Start positions in appendix A.2 of the thesis, (x, y) in m, in its order.
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

/// A test run: an episode of T steps from rest at a chosen position.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TestRun {
    /// (x, y) in m; the goal is the origin.
    pub start: [f64; 2],
    /// x in m, T + 1 values.
    pub x: Vec<f64>,
    /// y in m, T + 1 values.
    pub y: Vec<f64>,
    /// θ in rad, T values.
    pub direction: Vec<f64>,
    /// F_u in N, T values.
    pub force: Vec<f64>,
    /// T rewards.
    pub rewards: Vec<f64>,
}

/// The measured quantities of a test run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Measures {
    /// (x, y) in m; the goal is the origin.
    pub start: [f64; 2],
    /// The sum of the rewards.
    pub episode_return: f64,
    /// Distance d to the goal at the end, in m.
    pub final_distance: f64,
    /// The difference between the greatest and the least d at rest, in m.
    pub drift_at_rest: f64,
    /// Σ |Δθ| over the whole episode, in rad.
    pub turning: f64,
    /// Σ |Δθ| over its second half, in rad.
    pub turning_second_half: f64,
    /// Σ |Δθ| at rest, in rad.
    pub turning_at_rest: f64,
    /// Mean F_u until the goal is reached, or over the whole episode if it is not, in N.
    pub force_on_the_way: f64,
    /// Mean F_u at rest, in N.
    pub force_at_rest: f64,
}

impl TestRun {
    /// Test runs of the policy, one from rest at each of these positions.
    pub fn from_starts(rollout: &mut Rollout<'_>, starts: &[[f64; 2]]) -> anyhow::Result<Vec<Self>> {
        let run = |&[x, y]: &[f64; 2]| Ok(Self::of([x, y], &rollout.episode_from(&[x, y, 0.0, 0.0])?));
        starts.iter().map(run).collect()
    }

    /// From observations that start with (x, y), and actions (θ, F_u).
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

    /// The episode with rounded numbers, for a smaller file.
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

    /// The number of steps T.
    pub fn steps(&self) -> usize {
        self.force.len()
    }

    /// The positions (x, y) in m, T + 1 of them.
    pub fn path(&self) -> impl Iterator<Item = (f64, f64)> {
        self.x.iter().copied().zip(self.y.iter().copied())
    }

    /// d at each position, in m.
    pub fn distances(&self) -> impl Iterator<Item = f64> {
        self.path().map(|(x, y)| x.hypot(y))
    }

    /// Distance d to the goal at the end, in m.
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
    use crate::testing::test_run;

    #[test]
    fn the_quantities_of_a_test_run_are_measured() {
        let measures = test_run([2.0, -2.0], 0.03, 0.25, 1.5, 0.5).measures();
        assert!((measures.final_distance - 0.03).abs() < 1e-9, "{measures:?}");
        // A turn across the jump from π to −π still counts as small.
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
    fn a_test_run_that_never_reaches_the_goal_is_on_the_way_throughout() {
        let measures = test_run([3.0, 0.0], 1.0, 0.0, 2.0, 1.0).measures();
        assert!((measures.force_on_the_way - (80.0 * 2.0 + 120.0) / 200.0).abs() < 1e-9);
    }
}
