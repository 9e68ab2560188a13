//! Newer algorithms on the thesis's tasks: TD3 and SAC on the pendulum and the point mass.

mod pendulum;
mod point_mass;

pub(super) use pendulum::PendulumAlgorithms;
pub(super) use point_mass::PointMassAlgorithms;

use shoal_report::figure;

use super::experiment::{Experiment, Length, Milestone};
use super::report_section::{Figure, FigureWriter};
use super::result::SeedResult;

/// The name of all these experiments on the command line.
const CLI_NAME: &str = "methods";

/// An experiment whose preset has its name.
const fn experiment(
    name: &'static str,
    seeds: u32,
    (settings, quick): (&'static [&'static str], &'static [&'static str]),
    milestones: &'static [Milestone],
) -> Experiment {
    Experiment {
        name,
        cli_name: CLI_NAME,
        preset: name,
        settings,
        quick,
        seeds,
        milestones,
    }
}

const fn milestone(steps: u64) -> Milestone {
    Milestone {
        suffix: "",
        length: Length::Steps(steps),
        quick_length: Length::Steps(2_000),
    }
}

/// The figure with the learning curves of an experiment; `None` if it has no results.
fn learning_curves<T>(writer: &FigureWriter, name: &str, seeds: &[SeedResult<T>]) -> anyhow::Result<Option<Figure>> {
    let curves: Vec<_> = seeds.iter().map(SeedResult::curve).collect();
    if curves.is_empty() {
        return Ok(None);
    }
    let caption = "Mean return of the evaluations during training, every seed";
    let draw = |path: &std::path::Path| figure::learning_curves(name, &curves, None, path);
    writer.add(&format!("{name}-learning-curve"), caption, draw).map(Some)
}
