//! Newer algorithms on the thesis's tasks: TD3 and SAC on the pendulum and the point mass.

mod pendulum;
mod point_mass;

pub(super) use pendulum::PendulumAlgorithms;
pub(super) use point_mass::PointMassAlgorithms;

use super::experiment::{Experiment, Length, Stage};

/// The name of all these experiments on the command line.
const CLI_NAME: &str = "methods";

/// An experiment whose preset has its name.
const fn experiment(
    name: &'static str,
    seeds: u32,
    (settings, quick): (&'static [&'static str], &'static [&'static str]),
    stages: &'static [Stage],
) -> Experiment {
    Experiment {
        name,
        cli_name: CLI_NAME,
        preset: name,
        settings,
        quick,
        seeds,
        stages,
    }
}

const fn stage(steps: u64) -> Stage {
    Stage {
        suffix: "",
        length: Length::Steps(steps),
        quick_length: Length::Steps(2_000),
    }
}
