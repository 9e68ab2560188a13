//! The pendulum's swing-up from rest at the bottom, as in figure 4.9.

use std::f64::consts::TAU;
use std::path::Path;

use shoal_env_server::environment::pendulum::DT;
use shoal_run::evaluation::analysis::pendulum::SwingUp;

use super::canvas::{BLUE, INK, VERMILION, save};
use super::panel::{Axis, Panel, Series, range_of};

/// Draws two diagrams side by side: the torque, and the angle with the angular velocity.
pub fn swing_up(swing: &SwingUp, path: &Path) -> anyhow::Result<()> {
    let over_time = |values: &[f64]| {
        let timed = values.iter().enumerate();
        timed.map(|(t, v)| (t as f64 * DT, *v)).collect()
    };
    let SwingUp {
        angle,
        velocity,
        torque,
        ..
    } = swing;
    let end = torque.len().max(1) as f64 * DT;
    let time = || Axis::new("time (s)", 0.0..end);

    let action = Panel::new(
        "Control action",
        time(),
        Axis::new("torque (N m)", -2.2..2.2),
        vec![Series::line("", BLUE, over_time(torque))],
    );
    let extent = range_of(angle.iter().chain(velocity).copied().chain([-1.0, 1.0]));
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
    let motion = Panel::new(
        "Angle and angular velocity",
        time(),
        Axis::new("angle (rad), angular velocity (rad/s)", extent),
        series,
    );
    save(path, (1100, 420), |sheet| {
        let (left, right) = sheet.split_horizontally(sheet.dim_in_pixel().0 / 2);
        action.draw(&left)?;
        motion.draw(&right)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_run::testing::swing;

    #[test]
    fn a_swing_up_is_drawn() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("swing-up.svg");
        swing_up(&swing(0.0, 0.1), &path).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        assert!(svg.contains("torque (N m)") && svg.contains("angular velocity"));
    }
}
