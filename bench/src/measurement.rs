//! What every measurement has: how long it takes, when it is given up, and how it is told.

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

use super::target::Line;

/// Shortens or lengthens the measurement itself, in seconds: tests care for the form of the answer, not for the numbers.
const SECONDS: &str = "SHOAL_BENCH_SECONDS";
const DEFAULT_SECONDS: f64 = 6.0;

/// What is said where somebody asked for the end.
pub(super) const INTERRUPTED: &str = "interrupted";

/// What a stage's measurement gave: its fields are those of `--json`.
pub(super) trait Figures: Serialize {
    /// The same for people: what, and how much.
    fn lines(&self) -> Vec<(&'static str, String)>;

    /// The most important of them, each beside its limit and its target; none of a stage that `all` leaves out.
    fn table(&self) -> Vec<Line> {
        Vec::new()
    }
}

/// How long to measure, and when to give up.
#[derive(Clone, Debug)]
pub(super) struct Patience {
    pub(super) length: Duration,
    pub(super) stop: Stop,
}

/// A wait that ended early: somebody has asked for the end, or a channel does not work.
pub(super) fn interrupted(exit: Exit<ChannelError>) -> anyhow::Error {
    match exit {
        Exit::Stopped => anyhow::anyhow!(INTERRUPTED),
        Exit::Failed(error) => error.into(),
    }
}

impl Patience {
    pub(super) fn new() -> anyhow::Result<Self> {
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
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if self.stop.requested() {
            bail!(INTERRUPTED);
        }
        Ok(())
    }
}

pub(super) fn tell(figures: &impl Figures, json: bool) -> anyhow::Result<()> {
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
