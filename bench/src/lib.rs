//! `shoal bench`: how fast each stage is on this machine.

mod actors;
mod cores;
mod costs;
mod flow;
mod gym;
mod learner;
mod measurement;
mod memory;
mod model;
mod one_core;
mod policy;
mod processes;
mod product;
mod rows;
mod scene;
mod spin;
mod step;
mod table;
mod target;
mod transitions;
mod whole_run;
mod window;

use anyhow::bail;

use self::measurement::{Patience, tell};

/// A stage of the system.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Stage {
    /// Whole DDPG updates a second, sampling included.
    Learner,
    /// Rows a second from an actor process into the committed replay of a learner process.
    Transitions,
    /// Round trip between an actor process and an environment server process.
    Step,
    /// Actions a second.
    Policy,
    /// Rows a second of several actors, environments and learner included, and what is to be expected of more.
    Actors,
    /// A training: how long it takes to its first update and after a crash, and how much memory its processes have.
    Run,
    /// Every stage but `gym`, and one table of what they gave, the machine's limits, and what they should give.
    All,
    /// Steps of a Gymnasium environment through its server in Python, beside Gymnasium's own vectors.
    Gym,
}

/// Measures a stage and tells the person, or a script, how fast it is. `actors` lists how many actors [`Stage::Actors`] is to
/// measure.
///
/// # Errors
/// When a process does not do what is measured, or somebody asks for the end.
pub fn run(stage: Stage, actors: Option<&str>, json: bool) -> anyhow::Result<()> {
    let patience = Patience::new()?;
    if actors.is_some() && stage != Stage::Actors {
        bail!("--actors is for `shoal bench actors` alone");
    }
    match stage {
        Stage::Learner => learner::measure(&patience).and_then(|it| tell(&it, json)),
        Stage::Transitions => transitions::measure(&patience).and_then(|it| tell(&it, json)),
        Stage::Step => step::measure(&patience).and_then(|it| tell(&it, json)),
        Stage::Policy => policy::measure(&patience).and_then(|it| tell(&it, json)),
        Stage::Actors => actors::measure(actors, &patience).and_then(|it| tell(&it, json)),
        Stage::Run => whole_run::measure(&patience).and_then(|it| tell(&it, json)),
        Stage::All => table::measure_all(json, &patience),
        Stage::Gym => gym::measure(&patience).and_then(|it| tell(&it, json)),
    }
}
