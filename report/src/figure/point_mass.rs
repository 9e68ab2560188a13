//! The vehicle on its way to the goal: test runs as in figures 5.5, 5.7, 5.9 and A.4 to A.11, and all paths in one
//! diagram as in figure 5.10.

use std::f64::consts::PI;
use std::ops::Range;
use std::path::Path;

use shoal_run::evaluation::analysis::point_mass::TestRun;

use super::canvas::{Area, BLUE, GREEN, INK, VERMILION, save};
use super::panel::{Axis, Panel, Series, SeriesStyle, range_of};

/// Width and height of a diagram, in pixels.
pub(super) const CELL: (u32, u32) = (400, 330);

pub(super) fn distances(run: &TestRun) -> Vec<(f64, f64)> {
    over_steps(run.distances())
}

/// Draws one row of diagrams for each run: path, distance, actions, rewards.
pub fn test_runs(runs: &[TestRun], path: &Path) -> anyhow::Result<()> {
    let rewards = range_of(
        runs.iter()
            .flat_map(|run| run.rewards.iter().copied())
            .chain([0.0, 1.0]),
    );
    let farthest = runs.iter().flat_map(distances).map(|(_, d)| d).fold(1.0, f64::max);
    let size = (4 * CELL.0, (runs.len().max(1) as u32) * CELL.1);
    save(path, size, |sheet| {
        let cells = sheet.split_evenly((runs.len().max(1), 4));
        for (run, row) in runs.iter().zip(cells.chunks_exact(4)) {
            draw_path(run, &row[0])?;
            draw_distance("Distance to goal", run, farthest, &row[1])?;
            draw_actions("Control actions", run, &row[2])?;
            draw_rewards(run, rewards.clone(), &row[3])?;
        }
        Ok(())
    })
}

/// Draws the paths of all runs in one diagram and their distances to the goal in another.
pub fn trajectories(runs: &[TestRun], path: &Path) -> anyhow::Result<()> {
    let extent = extent(runs.iter().flat_map(TestRun::path));
    let thin = |points| Series {
        opacity: 0.75,
        width: 1.4,
        ..Series::line("", BLUE, points)
    };
    let mut lines: Vec<_> = runs.iter().map(|run| thin(run.path().collect())).collect();
    lines.push(starts(runs.iter().map(|run| (run.start[0], run.start[1])).collect()));
    lines.push(goal());
    let farthest = runs.iter().flat_map(distances).map(|(_, d)| d).fold(1.0, f64::max);
    let mean = runs.iter().map(TestRun::final_distance).sum::<f64>() / runs.len().max(1) as f64;
    let note = format!("mean at the end: {mean:.3} m");
    let (x, y) = (Axis::new("x (m)", extent.clone()), Axis::new("y (m)", extent));
    let paths = Panel {
        equal_scale: true,
        ..Panel::new("Trajectories", x, y, lines)
    };
    let distances = Panel {
        note: &note,
        ..Panel::new(
            "Distance to goal",
            time_steps(runs.iter().map(|run| run.steps()).max()),
            Axis::new("distance (m)", 0.0..1.05 * farthest),
            runs.iter().map(|run| thin(distances(run))).collect(),
        )
    };
    save(path, (1160, 560), |sheet| {
        let (left, right) = sheet.split_horizontally(sheet.dim_in_pixel().0 / 2);
        paths.draw(&left)?;
        distances.draw(&right)
    })
}

pub(super) fn draw_path(run: &TestRun, area: &Area<'_>) -> anyhow::Result<()> {
    let [x, y] = run.start;
    let extent = extent(run.path());
    let title = format!("From ({x}, {y})").replace('-', "\u{2212}");
    let series = vec![
        Series::line("", BLUE, run.path().collect()),
        starts(vec![(x, y)]),
        goal(),
    ];
    let (x, y) = (Axis::new("x (m)", extent.clone()), Axis::new("y (m)", extent));
    let panel = Panel {
        equal_scale: true,
        ..Panel::new(&title, x, y, series)
    };
    panel.draw(area)
}

pub(super) fn draw_distance(title: &str, run: &TestRun, farthest: f64, area: &Area<'_>) -> anyhow::Result<()> {
    let panel = Panel {
        note: &format!("{:.3} m at the end", run.final_distance()),
        ..Panel::new(
            title,
            time_steps(Some(run.steps())),
            Axis::new("distance (m)", 0.0..1.05 * farthest),
            vec![Series::line("", BLUE, distances(run))],
        )
    };
    panel.draw(area)
}

pub(super) fn draw_actions(title: &str, run: &TestRun, area: &Area<'_>) -> anyhow::Result<()> {
    let direction = over_steps(run.direction.iter().map(|theta| theta / PI));
    let force = over_steps(run.force.iter().copied());
    let series = vec![
        Series {
            width: 1.4,
            ..Series::line("force", BLUE, force)
        },
        Series {
            width: 1.4,
            ..Series::line("direction, scaled to [\u{2212}1, 1]", VERMILION, direction)
        },
    ];
    let y = Axis::new("force (N), direction (half turns)", -1.1..2.1);
    Panel::new(title, time_steps(Some(run.steps())), y, series).draw(area)
}

fn draw_rewards(run: &TestRun, range: Range<f64>, area: &Area<'_>) -> anyhow::Result<()> {
    let panel = Panel {
        note: &format!("return {:.1}", run.episode_return()).replace('-', "\u{2212}"),
        ..Panel::new(
            "Rewards",
            time_steps(Some(run.steps())),
            Axis::new("reward", range),
            vec![Series::line("", GREEN, over_steps(run.rewards.iter().copied()))],
        )
    };
    panel.draw(area)
}

pub(super) fn starts<'a>(points: Vec<(f64, f64)>) -> Series<'a> {
    Series {
        style: SeriesStyle::Rings,
        ..Series::line("start", INK, points)
    }
}

pub(super) fn goal<'a>() -> Series<'a> {
    Series {
        style: SeriesStyle::Crosses,
        width: 2.2,
        ..Series::line("goal", VERMILION, vec![(0.0, 0.0)])
    }
}

pub(super) fn over_steps(values: impl Iterator<Item = f64>) -> Vec<(f64, f64)> {
    values.enumerate().map(|(t, value)| (t as f64, value)).collect()
}

pub(super) fn time_steps<'a>(steps: Option<usize>) -> Axis<'a> {
    Axis::new("time step", 0.0..steps.unwrap_or(1).max(1) as f64)
}

/// The x and y range of a square that is centred on the goal and contains all points.
pub(super) fn extent(points: impl Iterator<Item = (f64, f64)>) -> Range<f64> {
    let farthest = points
        .flat_map(|(x, y)| [x.abs(), y.abs()])
        .filter(|r| r.is_finite())
        .fold(0.5, f64::max);
    -1.15 * farthest..1.15 * farthest
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_run::testing::test_run;

    fn run(start: [f64; 2]) -> TestRun {
        test_run(start, 0.01, 0.3, 1.5, 0.1)
    }

    #[test]
    fn each_run_has_a_row_of_diagrams() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("test-runs.svg");
        test_runs(&[run([2.0, -2.0]), run([-2.0, 2.0])], &path).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        for label in ["x (m)", "distance (m)", "force (N), direction (half turns)", "reward"] {
            assert_eq!(svg.lines().filter(|line| line.trim() == label).count(), 2, "{label}");
        }
        assert!(svg.contains("From (2, \u{2212}2)") && svg.contains("From (\u{2212}2, 2)"));
    }

    #[test]
    fn any_number_of_paths_can_be_drawn() {
        let dir = tempfile::tempdir().unwrap();
        let starts = [[3.0, 3.0], [3.0, 0.0], [3.0, -3.0], [0.0, -3.0], [2.0, 2.0]];
        trajectories(&starts.map(run), &dir.path().join("trajectories.svg")).unwrap();
        trajectories(&[], &dir.path().join("none.svg")).unwrap();
    }
}
