//! `shoal bench`: how fast each stage is on this machine.

mod actors;
mod cores;
mod costs;
mod crew;
mod flow;
mod gym;
mod learner;
mod memory;
mod model;
mod one_core;
mod policy;
mod product;
mod rows;
mod scene;
mod spin;
mod step;
mod table;
mod transitions;
mod whole_run;
mod window;

use std::io::Write;
use std::time::Duration;

use anyhow::{Context, bail};
use comfy_table::Table;
use comfy_table::presets::UTF8_BORDERS_ONLY;
use serde::Serialize;
use shoal_common::channel::ChannelError;
use shoal_common::exit::Exit;
use shoal_common::stop::Stop;
use shoal_run::signals::Signals;

/// Shortens or lengthens the measurement itself, in seconds: tests care for the form of the answer, not for the numbers.
const SECONDS: &str = "SHOAL_BENCH_SECONDS";
const DEFAULT_SECONDS: f64 = 6.0;

/// What is said where somebody asked for the end.
const INTERRUPTED: &str = "interrupted";

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

/// What a stage's measurement gave: its fields are those of `--json`.
trait Figures: Serialize {
    /// The same for people: what, and how much.
    fn lines(&self) -> Vec<(&'static str, String)>;

    /// The most important of them, each beside its limit and its target; none of a stage that `all` leaves out.
    fn table(&self) -> Vec<table::Line> {
        Vec::new()
    }
}

/// How long to measure, and when to give up.
#[derive(Clone, Debug)]
struct Patience {
    length: Duration,
    stop: Stop,
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

/// A wait that ended early: somebody has asked for the end, or a channel does not work.
fn interrupted(exit: Exit<ChannelError>) -> anyhow::Error {
    match exit {
        Exit::Stopped => anyhow::anyhow!(INTERRUPTED),
        Exit::Failed(error) => error.into(),
    }
}

impl Patience {
    fn new() -> anyhow::Result<Self> {
        let seconds = match std::env::var(SECONDS) {
            Ok(text) => text.parse().ok().filter(|seconds| (0.01..=600.0).contains(seconds)),
            Err(_) => Some(DEFAULT_SECONDS),
        };
        let seconds = seconds.with_context(|| format!("{SECONDS} must be a number of seconds from 0.01 to 600"))?;
        let stop = Stop::default();
        let flag = stop.clone();
        let signals = Signals::register()?;
        std::thread::Builder::new()
            .name("signals".into())
            .spawn(move || {
                while signals.wait(Duration::from_secs(60)).is_none() {}
                flag.request();
            })
            .context("cannot watch for signals")?;
        Ok(Self {
            length: Duration::from_secs_f64(seconds),
            stop,
        })
    }

    /// An error once somebody has asked for the end: what was measured is cleared away on the way out.
    fn check(&self) -> anyhow::Result<()> {
        if self.stop.requested() {
            bail!(INTERRUPTED);
        }
        Ok(())
    }
}

fn tell(figures: &impl Figures, json: bool) -> anyhow::Result<()> {
    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    for (what, how_much) in figures.lines() {
        table.add_row([what, &how_much]);
    }
    if json {
        writeln!(std::io::stderr().lock(), "{table}")?;
        writeln!(std::io::stdout().lock(), "{}", serde_json::to_string(figures)?)?;
    } else {
        writeln!(std::io::stdout().lock(), "{table}")?;
    }
    Ok(())
}
