//! The figures of chapter 5 and appendix A.

use std::ops::Range;

use shoal_report::figure::{self, Agent};

use super::super::report_section::{Figure, FigureWriter};
use super::super::result::{SeedResult, representative};
use super::Measurements;

/// The figures of a reward.
pub(super) struct RewardFigures {
    name: &'static str,
    curve: &'static str,
    test_runs: &'static str,
    /// The test runs of a result that the thesis shows.
    shown: Range<usize>,
}

pub(super) const R1: RewardFigures = RewardFigures {
    name: "r1",
    curve: "5.4",
    test_runs: "5.5",
    shown: 0..2,
};
pub(super) const R2: RewardFigures = RewardFigures {
    name: "r2",
    curve: "5.6",
    test_runs: "5.7",
    shown: 2..4,
};
const R3: RewardFigures = RewardFigures {
    name: "r3",
    curve: "5.8",
    test_runs: "5.9",
    shown: 0..2,
};

/// The test runs from the starts of section 5.3, and the test runs of the two halves of appendix A.2.
const NEAR: Range<usize> = 0..4;
const FAR: [(Range<usize>, &str, &str); 2] = [(4..8, "far-1", "A.4 to A.7"), (8..12, "far-2", "A.8 to A.11")];

/// The figures of learning curves and of two test runs.
pub(super) fn of_reward(
    writer: &FigureWriter,
    of: &RewardFigures,
    seeds: &[SeedResult<Measurements>],
) -> anyhow::Result<Vec<Figure>> {
    let Some(middle) = representative(seeds) else {
        return Ok(Vec::new());
    };
    let RewardFigures {
        name,
        curve,
        test_runs,
        shown,
    } = of;
    let curves: Vec<_> = seeds.iter().map(SeedResult::curve).collect();
    Ok(vec![
        writer.add(
            &format!("point-mass-{name}-learning-curve"),
            format!("Mean return of the evaluations during training with {name}, every seed (figure {curve})"),
            |path| figure::learning_curves(&format!("Point mass with {name}"), &curves, None, path),
        )?,
        writer.add(
            &format!("point-mass-{name}-test-runs"),
            format!(
                "Two test runs with {name}, seed {} (figure {test_runs})",
                middle.header.seed
            ),
            |path| figure::test_runs(&middle.measurements.test_runs[shown.clone()], path),
        )?,
    ])
}

/// The same figures for r3, and figures of the test runs from far away.
pub(super) fn of_r3(writer: &FigureWriter, seeds: &[SeedResult<Measurements>]) -> anyhow::Result<Vec<Figure>> {
    let mut figures = of_reward(writer, &R3, seeds)?;
    if let Some(middle) = representative(seeds) {
        for (range, file, numbers) in FAR {
            let caption = format!(
                "Test runs with r3 from far away, seed {} (figures {numbers})",
                middle.header.seed
            );
            figures.push(writer.add(&format!("point-mass-r3-{file}"), caption, |path| {
                figure::test_runs(&middle.measurements.test_runs[range], path)
            })?);
        }
    }
    Ok(figures)
}

/// The figures of paths, actions and distances of the agents that have results.
pub(super) fn of_comparison(
    writer: &FigureWriter,
    rewards: [&[SeedResult<Measurements>]; 3],
) -> anyhow::Result<Vec<Figure>> {
    let named = ["r1", "r2", "r3"].into_iter().zip(rewards);
    let agents: Vec<Agent<'_>> = named
        .filter_map(|(name, seeds)| {
            let middle = representative(seeds)?;
            Some(Agent {
                name: format!("{name} (seed {})", middle.header.seed),
                test_runs: middle.measurements.test_runs[NEAR].iter().collect(),
            })
        })
        .collect();
    if agents.is_empty() {
        return Ok(Vec::new());
    }
    Ok(vec![
        writer.add(
            "point-mass-paths",
            "Paths from the four starts of section 5.3 (figure 5.10)",
            |path| figure::compare_paths(&agents, path),
        )?,
        writer.add(
            "point-mass-actions",
            "Actions and position error from (2, \u{2212}2) (figure 5.11)",
            |path| figure::compare_actions(&agents, path),
        )?,
    ])
}

/// The figures of r2 after the additional training.
pub(super) fn of_longer(writer: &FigureWriter, seeds: &[SeedResult<Measurements>]) -> anyhow::Result<Vec<Figure>> {
    let Some(middle) = representative(seeds) else {
        return Ok(Vec::new());
    };
    let curves: Vec<_> = seeds.iter().map(SeedResult::curve).collect();
    // The additional training is as long as the first one.
    let end = middle.evaluations.last().map_or(0, |it| it.steps);
    let half = (end / 2, "end of the first training");
    Ok(vec![
        writer.add(
            "point-mass-r2-longer-test-runs",
            format!(
                "Two test runs of the last policy after additional training with r2, seed {} (figures A.1 and A.2)",
                middle.header.seed
            ),
            |path| figure::test_runs(&middle.measurements.last_test_runs[R2.shown.clone()], path),
        )?,
        writer.add(
            "point-mass-r2-longer-learning-curve",
            "Mean return of the evaluations during training with r2, with additional training (figure A.3)",
            |path| figure::learning_curves("Point mass with r2, trained for longer", &curves, Some(half), path),
        )?,
    ])
}
