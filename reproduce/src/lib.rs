//! Runs the thesis's experiments over several seeds with Shoal itself, stores their results, and writes the report.
//!
//! A new experiment needs a file with a `family::Family`, and a line in `FAMILIES`.

mod cart_pole;
mod claim;
mod experiment;
mod family;
mod folder;
mod frozen_lake;
mod newer_algorithms;
mod pendulum;
mod point_mass;
mod progress;
mod queue;
mod report;
mod report_section;
mod request;
mod result;
mod results_file;
mod settings;
mod training;

use std::collections::BTreeMap;

use anyhow::Context;

pub use self::experiment::Effort;
use self::experiment::Experiment;
use self::family::{FamilyEntry, entry};
use self::folder::Folder;
use self::queue::SeedQueue;
use self::request::Job;
pub use self::request::{ReproductionEnd, Request};
use self::settings::RunSettings;

/// Every family, in the report's order.
const FAMILIES: [FamilyEntry; 6] = [
    entry::<frozen_lake::FrozenLake>(),
    entry::<cart_pole::CartPole>(),
    entry::<pendulum::Pendulum>(),
    entry::<point_mass::PointMass>(),
    entry::<newer_algorithms::PendulumAlgorithms>(),
    entry::<newer_algorithms::PointMassAlgorithms>(),
];

/// The names of the experiments on the command line.
pub fn names() -> impl Iterator<Item = &'static str> {
    let mut names: Vec<_> = experiments().map(|(_, experiment)| experiment.cli_name).collect();
    names.dedup();
    names.into_iter()
}

/// Runs the requested seeds that have no result yet, stores each result, and writes the report from all results in the
/// folder.
pub fn run(request: &Request) -> anyhow::Result<ReproductionEnd> {
    let folder = Folder::open(&request.folder, experiments().map(|(_, experiment)| experiment))?;
    let settings = expected(request.effort)?;
    let requested = experiments()
        .filter(|(_, it)| request.experiments.is_empty() || request.experiments.iter().any(|name| name == it.cli_name));
    let jobs: Vec<Job> = requested
        .flat_map(|(family, experiment)| {
            let seeds = request.seeds.unwrap_or(experiment.seeds(request.effort));
            (1..=u64::from(seeds)).map(move |seed| Job {
                family,
                experiment,
                seed,
            })
        })
        .collect();
    // Results and runs with other settings are refused before anything starts.
    for (_, experiment) in experiments() {
        folder.check(experiment, request.effort, &settings[experiment.name])?;
    }
    folder.move_old_results()?;
    let write = |failures: &BTreeMap<_, _>| {
        report::write(&FAMILIES, &folder, request, &jobs, failures)
            .with_context(|| format!("cannot write the report {}", request.report.display()))
    };
    let queue = SeedQueue {
        folder: &folder,
        effort: request.effort,
        jobs: &jobs,
        settings: &settings,
    };
    queue.run(request.parallel, write)
}

fn experiments() -> impl Iterator<Item = (&'static FamilyEntry, &'static Experiment)> {
    const ENTRIES: &[FamilyEntry] = &FAMILIES;
    ENTRIES
        .iter()
        .flat_map(|entry| entry.experiments.iter().map(move |experiment| (entry, experiment)))
}

/// The settings with which this version runs each experiment.
fn expected(effort: Effort) -> anyhow::Result<BTreeMap<&'static str, RunSettings>> {
    experiments()
        .map(|(_, experiment)| Ok((experiment.name, RunSettings::expected(experiment, effort)?)))
        .collect()
}
