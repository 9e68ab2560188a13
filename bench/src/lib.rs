//! `shoal bench`: how fast each stage is on this machine.

mod actors;
mod cores;
mod costs;
mod gym;
mod intervals;
mod learner;
mod measurement;
mod memory;
mod model;
mod one_core;
mod policy;
mod processes;
mod product;
mod progress;
#[cfg(feature = "remote")]
mod remote;
mod rows;
mod spin;
mod step;
mod table;
mod target;
mod temporary_run;
mod transitions;
mod whole_run;

use shoal_common::algorithms::AlgorithmConfig;
use shoal_run::usage::UsageError;

use self::measurement::{TimeBudget, print};

/// The algorithms that [`Stage::Learner`] and [`Stage::Policy`] can measure, which learn from minibatches.
pub fn algorithms() -> impl Iterator<Item = &'static str> {
    AlgorithmConfig::all_with_minibatches().map(|algorithm| algorithm.name())
}

/// A stage to measure.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Stage {
    /// Gradient steps per second, sampling included.
    Learner,
    /// Transitions per second from an actor process into the replay of a learner process.
    Transitions,
    /// Round-trip time between an actor process and an environment server process.
    Step,
    /// Actions per second that the policy chooses, without and with exploration.
    Policy,
    /// Environment steps per second of several actors, environments and learner included, and a prediction for more
    /// actors.
    Actors,
    /// A training run: time to its first gradient steps, time to recover from a crash, and memory of each process.
    Run,
    /// Transitions per second from actors of other hosts, what gate and relay cost, and how soon transitions come back
    /// after an interruption.
    Remote,
    /// Every stage except `gym` and `remote`, and one table of the results, the machine's limits and the targets.
    All,
    /// Steps per second of a Gymnasium environment served from Python, compared with Gymnasium's own vector
    /// environments.
    Gym,
}

/// Measures a stage and prints the result, as a table or with `json` also as one JSON object. `actors` lists the
/// numbers of actors that [`Stage::Actors`] measures, `algorithm` is what [`Stage::Learner`] or [`Stage::Policy`]
/// measures.
///
/// # Errors
/// If a measured process fails, or the user interrupts.
pub fn run(stage: Stage, actors: Option<&str>, algorithm: Option<&str>, json: bool) -> anyhow::Result<()> {
    let budget = TimeBudget::new()?;
    if actors.is_some() && stage != Stage::Actors {
        return Err(UsageError("--actors is only for `shoal bench actors`".into()).into());
    }
    if algorithm.is_some() && !matches!(stage, Stage::Learner | Stage::Policy) {
        return Err(UsageError("--method is only for `shoal bench learner` and `shoal bench policy`".into()).into());
    }
    match stage {
        Stage::Learner => learner::measure(algorithm, &budget).and_then(|it| print(&it, json)),
        Stage::Transitions => transitions::measure(&budget).and_then(|it| print(&it, json)),
        Stage::Step => step::measure(&budget).and_then(|it| print(&it, json)),
        Stage::Policy => policy::measure(algorithm, &budget).and_then(|it| print(&it, json)),
        Stage::Actors => actors::measure(actors, &budget).and_then(|it| print(&it, json)),
        Stage::Run => whole_run::measure(&budget).and_then(|it| print(&it, json)),
        #[cfg(feature = "remote")]
        Stage::Remote => remote::measure(&budget).and_then(|it| print(&it, json)),
        #[cfg(not(feature = "remote"))]
        Stage::Remote => anyhow::bail!(shoal_remote::NOT_BUILT),
        Stage::All => table::measure_all(json, &budget),
        Stage::Gym => gym::measure(&budget).and_then(|it| print(&it, json)),
    }
}
