//! The thesis's experiments, run through the system itself over several seeds; what is kept of each, and the report.
//!
//! A new experiment is a file with a [`family::Family`] and a line in [`FAMILIES`].

mod batch;
mod cart_pole;
mod claim;
mod experiment;
mod family;
mod folder;
mod frozen_lake;
mod pendulum;
mod point_mass;
mod progress;
mod report;
mod result;
mod results_file;
mod settings;
mod training;

use std::collections::BTreeMap;
use std::path::PathBuf;

use anyhow::Context;

use self::batch::{Batch, Job};
pub use self::experiment::Effort;
use self::experiment::Experiment;
use self::family::{Entry, entry};
use self::folder::Folder;
use self::settings::Settings;

/// Every family, in the report's order.
const FAMILIES: [Entry; 4] = [
    entry::<frozen_lake::FrozenLake>(),
    entry::<cart_pole::CartPole>(),
    entry::<pendulum::Pendulum>(),
    entry::<point_mass::PointMass>(),
];

/// What is to be reproduced, and how.
#[derive(Clone, Debug)]
pub struct Order {
    /// Names of experiments; all of them where it is empty.
    pub experiments: Vec<String>,
    /// Seeds 1 to this one; as many as each experiment has by itself where it is none.
    pub seeds: Option<u32>,
    /// Trainings at a time.
    pub jobs: usize,
    /// How much of each experiment is run.
    pub effort: Effort,
    /// Where runs, results and figures lie.
    pub folder: PathBuf,
    /// Whether every figure is drawn as PNG as well as SVG.
    pub png: bool,
    /// The file that the report is written to.
    pub report: PathBuf,
}

/// How it went.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ending {
    /// Every result that was asked for is there.
    Complete,
    /// So many seeds have failed.
    Failed(usize),
    /// By this signal; every training has saved its state.
    Interrupted(i32),
}

/// The experiments that can be asked for.
pub fn names() -> impl Iterator<Item = &'static str> {
    let mut names: Vec<_> = experiments().map(|(_, experiment)| experiment.asked_as).collect();
    names.dedup();
    names.into_iter()
}

/// Runs what is due, keeps each result, and writes the report from all results of the folder.
pub fn run(order: &Order) -> anyhow::Result<Ending> {
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
fn expected(effort: Effort) -> anyhow::Result<BTreeMap<&'static str, Settings>> {
    experiments()
        .map(|(_, experiment)| Ok((experiment.name, Settings::expected(experiment, effort)?)))
        .collect()
}
