//! The thesis's experiments, run through the system itself over several seeds; what is kept of each, and the report.
//!
//! A new experiment is a file with a [`family::Family`] and a line in [`FAMILIES`].

mod album;
mod batch;
mod cart_pole;
mod claim;
mod experiment;
mod family;
mod folder;
mod frozen_lake;
mod order;
mod pendulum;
mod point_mass;
mod progress;
mod report;
mod result;
mod results_file;
mod settings;
mod training;

use std::collections::BTreeMap;

use anyhow::Context;

use self::batch::Batch;
pub use self::experiment::Effort;
use self::experiment::Experiment;
use self::family::{Entry, entry};
use self::folder::Folder;
use self::order::Job;
pub use self::order::{BatchEnding, Order};
use self::settings::RunSettings;

/// Every family, in the report's order.
const FAMILIES: [Entry; 4] = [
    entry::<frozen_lake::FrozenLake>(),
    entry::<cart_pole::CartPole>(),
    entry::<pendulum::Pendulum>(),
    entry::<point_mass::PointMass>(),
];

/// The experiments that can be asked for.
pub fn names() -> impl Iterator<Item = &'static str> {
    let mut names: Vec<_> = experiments().map(|(_, experiment)| experiment.asked_as).collect();
    names.dedup();
    names.into_iter()
}

/// Runs what is due, keeps each result, and writes the report from all results of the folder.
pub fn run(order: &Order) -> anyhow::Result<BatchEnding> {
    let folder = Folder::open(&order.folder, experiments().map(|(_, experiment)| experiment))?;
    let settings = expected(order.effort)?;
    let wanted = experiments()
        .filter(|(_, it)| order.experiments.is_empty() || order.experiments.iter().any(|name| name == it.asked_as));
    let jobs: Vec<Job> = wanted
        .flat_map(|(family, experiment)| {
            let seeds = order.seeds.unwrap_or(experiment.seeds(order.effort));
            (1..=u64::from(seeds)).map(move |seed| Job {
                family,
                experiment,
                seed,
            })
        })
        .collect();
    // What does not belong here is refused before anything starts.
    for (_, experiment) in experiments() {
        folder.check(experiment, order.effort, &settings[experiment.name])?;
    }
    folder.take_over()?;
    let write = |failures: &BTreeMap<_, _>| {
        report::write(&FAMILIES, &folder, order, &jobs, failures)
            .with_context(|| format!("cannot write the report {}", order.report.display()))
    };
    let batch = Batch {
        folder: &folder,
        effort: order.effort,
        jobs: &jobs,
        settings: &settings,
    };
    batch.run(order.jobs, write)
}

fn experiments() -> impl Iterator<Item = (&'static Entry, &'static Experiment)> {
    const ENTRIES: &[Entry] = &FAMILIES;
    ENTRIES
        .iter()
        .flat_map(|entry| entry.experiments.iter().map(move |experiment| (entry, experiment)))
}

/// With which settings each experiment is run by this program.
fn expected(effort: Effort) -> anyhow::Result<BTreeMap<&'static str, RunSettings>> {
    experiments()
        .map(|(_, experiment)| Ok((experiment.name, RunSettings::expected(experiment, effort)?)))
        .collect()
}
