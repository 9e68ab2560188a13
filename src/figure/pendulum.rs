//! The pendulum's swing-up from rest at the bottom, as in figure 4.9.

use std::f64::consts::{PI, TAU};
use std::path::Path;

use super::canvas::{BLUE, INK, VERMILION, save};
use super::panel::{Axis, Panel, Series, range_of};
use crate::rollout::Trajectory;

/// Δt in s.
const DT: f64 = 0.05;

/// Draws the torque, and the angle and angular velocity, of an episode that starts at `theta` (rad, 0 is upright).
pub(crate) fn swing_up(trajectory: &Trajectory, theta: f64, path: &Path) -> anyhow::Result<()> {
    let over_time = |values: Vec<f64>| {
        values
            .into_iter()
            .enumerate()
            .map(|(t, v)| (t as f64 * DT, v))
            .collect()
    };
    let torque = trajectory.actions.iter().map(|a| a[0].into()).collect();
    let velocity: Vec<f64> = trajectory.observations.iter().map(|o| o[2].into()).collect();
    let angle = angles(&trajectory.observations, theta);
    let end = (trajectory.actions.len().max(1)) as f64 * DT;
    let time = || Axis {
        label: "time (s)",
        range: 0.0..end,
    };

    let action = Panel {
        title: "Control action",
        note: "",
        x: time(),
        y: Axis {
            label: "torque (N m)",
            range: -2.2..2.2,
        },
        series: vec![Series::line("", BLUE, over_time(torque))],
        equal_scale: false,
    };
    let extent = range_of(angle.iter().chain(&velocity).copied().chain([-1.0, 1.0]));
    let mut series = vec![
        Series::line("angle", BLUE, over_time(angle)),
        Series::line("angular velocity", VERMILION, over_time(velocity)),
    ];
    let uprights = (-9..=9)
        .map(|turns| f64::from(turns) * TAU)
        .filter(|upright| extent.contains(upright));
    for (upright, label) in uprights.zip(["upright (0 and whole turns)"].into_iter().chain(std::iter::repeat(""))) {
        let level = Series::line(label, INK, vec![(0.0, upright), (end, upright)]);
        series.push(Series {
            opacity: 0.6,
            width: 0.9,
            ..level
        });
    }
    let motion = Panel {
        title: "Angle and angular velocity",
        note: "",
        x: time(),
        y: Axis {
            label: "angle (rad), angular velocity (rad/s)",
            range: extent,
        },
        series,
        equal_scale: false,
    };
    save(path, (1100, 420), |sheet| {
        let (left, right) = sheet.split_horizontally(sheet.dim_in_pixel().0 / 2);
        action.draw(&left)?;
        motion.draw(&right)
    })
}

/// The angle at each observation (cos θ, sin θ, θ̇), without jumps, from `theta` on. It turns by less than half a turn a step.
fn angles(observations: &[Vec<f32>], theta: f64) -> Vec<f64> {
    let follow = |angle: &mut f64, observation: &Vec<f32>| {
        let seen = f64::from(observation[1]).atan2(observation[0].into());
        *angle += (seen - *angle + PI).rem_euclid(TAU) - PI;
        Some(*angle)
    };
    observations.iter().scan(theta, follow).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(theta: f64) -> Vec<f32> {
        vec![theta.cos() as f32, theta.sin() as f32, 0.0]
    }

    #[test]
    fn the_angle_goes_on_through_whole_turns() {
        for direction in [1.0, -1.0] {
            let turning: Vec<f64> = (0..100).map(|t| PI + direction * 0.39 * f64::from(t)).collect();
            let observations: Vec<_> = turning.iter().map(|theta| seen(*theta)).collect();
            for (found, expected) in angles(&observations, PI).iter().zip(&turning) {
                assert!((found - expected).abs() < 1e-5, "{found} for {expected}");
            }
        }
    }

    #[test]
    fn a_swing_up_makes_a_picture() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("swing-up.svg");
        let theta = |t: f64| PI * (1.0 - t / 60.0).max(0.0) + (t / 8.0).sin() * (-t / 40.0).exp();
        let observations = (0..=200).map(|t| seen(theta(t.into()))).collect();
        let actions = (0..200)
            .map(|t| vec![if t < 60 && t % 30 < 15 { -2.0 } else { 0.1 }])
            .collect();
        let trajectory = Trajectory {
            observations,
            actions,
            rewards: vec![-1.0; 200],
            terminated: false,
        };
        swing_up(&trajectory, PI, &path).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        assert!(svg.contains("torque (N m)") && svg.contains("angular velocity"));
    }
}
