//! An environment's signals over one episode, one diagram for each.

use std::path::Path;

use shoal_env_server::environment::Signal;
use shoal_run::evaluation::rollout::Trajectory;

use super::canvas::{BLUE, save};
use super::panel::{Axis, Panel, Series, range_of};

/// Width of the figure and height of each diagram, in pixels.
const WIDTH: u32 = 860;
const HEIGHT: u32 = 210;

/// Draws the signals over time. `time_step` is the duration of a step in s; without it the x axis counts steps.
pub fn episode(signals: &[Signal], time_step: Option<f64>, trajectory: &Trajectory, path: &Path) -> anyhow::Result<()> {
    let (unit, label) = match time_step {
        Some(seconds) => (seconds, "time (s)"),
        None => (1.0, "step"),
    };
    let end = trajectory.actions.len().max(1) as f64 * unit;
    let rows = signals.len().max(1);
    save(path, (WIDTH, HEIGHT * rows as u32), |sheet| {
        for (signal, row) in signals.iter().zip(sheet.split_evenly((rows, 1))) {
            let values = trajectory.values(signal.source);
            let y = Axis::new(&signal.unit, range_of(values.iter().copied()));
            let points = (0..).map(|t| f64::from(t) * unit).zip(values).collect();
            let series = vec![Series::line("", BLUE, points)];
            Panel::new(&signal.label, Axis::new(label, 0.0..end), y, series).draw(&row)?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_signal_has_a_diagram() {
        let trajectory = Trajectory {
            observations: (0..=40u8).map(|t| vec![f32::from(t), f32::NAN]).collect(),
            actions: (0..40u8).map(|t| vec![f32::from(t % 2)]).collect(),
            ..Trajectory::default()
        };
        let signals = [
            Signal::observation(0, "position", "m"),
            Signal::observation(1, "nothing", "V"),
            Signal::action(0, "push", "").label("push (0 ←, 1 →)"),
        ];
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("episode.svg");
        let drawn = |signals: &[Signal], time_step, trajectory: &Trajectory| {
            episode(signals, time_step, trajectory, &path).unwrap();
            std::fs::read_to_string(&path).unwrap()
        };
        let svg = drawn(&signals, Some(0.05), &trajectory);
        for label in ["position", "nothing", "push (0 ←, 1 →)", "time (s)", "m"] {
            assert!(svg.lines().any(|line| line.trim() == label), "{label}");
        }
        assert!(
            drawn(&signals, None, &trajectory)
                .lines()
                .any(|line| line.trim() == "step")
        );
        drawn(&[], None, &Trajectory::default());
        drawn(&signals, None, &Trajectory::default());
    }
}
