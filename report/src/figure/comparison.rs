//! Several agents side by side, as in figures 5.10 and 5.11.

use std::path::Path;

use shoal_run::evaluation::analysis::point_mass::TestRun;

use super::canvas::{BLUE, save};
use super::panel::{Axis, Panel, Series};
use super::point_mass::{CELL, draw_actions, draw_distance, extent, goal, starts};

/// An agent and its test runs.
pub struct Agent<'a> {
    /// Its name in the diagram's title.
    pub name: String,
    /// Its episodes, one from each start position.
    pub test_runs: Vec<&'a TestRun>,
}

/// Draws one diagram for each agent, with the paths of all its episodes.
pub fn compare_paths(agents: &[Agent<'_>], path: &Path) -> anyhow::Result<()> {
    let points = agents
        .iter()
        .flat_map(|agent| &agent.test_runs)
        .flat_map(|run| run.path());
    let range = extent(points);
    let size = (agents.len().max(1) as u32 * 420, 450);
    save(path, size, |sheet| {
        for (agent, cell) in agents.iter().zip(sheet.split_evenly((1, agents.len().max(1)))) {
            let paths = agent.test_runs.iter().map(|run| Series {
                width: 1.5,
                ..Series::line("", BLUE, run.path().collect())
            });
            let start_points = agent.test_runs.iter().map(|run| (run.start[0], run.start[1]));
            let series = paths.chain([starts(start_points.collect()), goal()]).collect();
            let (x, y) = (Axis::new("x (m)", range.clone()), Axis::new("y (m)", range.clone()));
            Panel {
                equal_scale: true,
                ..Panel::new(&agent.name, x, y, series)
            }
            .draw(&cell)?;
        }
        Ok(())
    })
}

/// Draws one row for each agent, with the actions and the distance to the goal in its first episode.
pub fn compare_actions(agents: &[Agent<'_>], path: &Path) -> anyhow::Result<()> {
    let firsts: Vec<(&str, &TestRun)> = agents
        .iter()
        .filter_map(|agent| Some((agent.name.as_str(), *agent.test_runs.first()?)))
        .collect();
    let farthest = firsts.iter().flat_map(|(_, run)| run.distances()).fold(1.0, f64::max);
    let rows = firsts.len().max(1);
    save(path, (1160, rows as u32 * CELL.1), |sheet| {
        for ((name, run), row) in firsts.iter().zip(sheet.split_evenly((rows, 2)).chunks_exact(2)) {
            draw_actions(&format!("{name}: control actions"), run, &row[0])?;
            draw_distance(&format!("{name}: distance to goal"), run, farthest, &row[1])?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_run::testing::test_run;

    #[test]
    fn agents_are_drawn_side_by_side() {
        let dir = tempfile::tempdir().unwrap();
        let test_runs = [
            test_run([2.0, -2.0], 0.0, 1.0, 2.0, 1.0),
            test_run([-2.0, 2.0], 0.1, 0.1, 1.0, 0.0),
        ];
        let agents: Vec<_> = ["r1", "r2", "r3"]
            .map(|name| Agent {
                name: name.into(),
                test_runs: test_runs.iter().collect(),
            })
            .into();
        for agents in [&agents[..], &[]] {
            let [paths, actions] = ["paths.svg", "actions.svg"].map(|file| dir.path().join(file));
            compare_paths(agents, &paths).unwrap();
            compare_actions(agents, &actions).unwrap();
            let svg = std::fs::read_to_string(actions).unwrap();
            assert_eq!(svg.contains("r2: control actions"), !agents.is_empty());
        }
    }
}
