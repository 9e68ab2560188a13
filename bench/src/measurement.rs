//! What all measurements share: length, interruption and output.

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

use super::target::TargetRow;

/// Environment variable for the length of a measurement in seconds. Tests set it low: they check the form of the
/// output.
const SECONDS: &str = "SHOAL_BENCH_SECONDS";
const DEFAULT_SECONDS: f64 = 6.0;

/// The error message after the user interrupted.
pub(super) const INTERRUPTED: &str = "interrupted";

/// The results of a stage. Their serialized fields are the fields of `--json`.
pub(super) trait StageResults: Serialize {
    /// The results for the user: pairs of a name and a value.
    fn entries(&self) -> Vec<(&'static str, String)>;

    /// The most important results with limits and targets, for the table of `bench all`; empty if `all` omits the
    /// stage.
    fn target_rows(&self) -> Vec<TargetRow> {
        Vec::new()
    }
}

/// How long to measure, and whether the user has interrupted.
#[derive(Clone, Debug)]
pub(super) struct TimeBudget {
    pub(super) length: Duration,
    pub(super) stop: Stop,
}

/// The error of a wait that ended early: the user interrupted, or a channel failed.
pub(super) fn interrupted(exit: Exit<ChannelError>) -> anyhow::Error {
    match exit {
        Exit::Stopped => anyhow::anyhow!(INTERRUPTED),
        Exit::Failed(error) => error.into(),
    }
}

impl TimeBudget {
    pub(super) fn new() -> anyhow::Result<Self> {
        let seconds = match std::env::var(SECONDS) {
            Ok(text) => {
                let seconds = text.parse::<f64>().ok();
                seconds
                    .filter(|seconds| (0.01..=600.0).contains(seconds))
                    .with_context(|| format!("{SECONDS}={text:?}: must be a number of seconds from 0.01 to 600"))?
            }
            Err(_) => DEFAULT_SECONDS,
        };
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

    /// Returns an error once the user has interrupted. Callers clean up on the way out.
    pub(super) fn check(&self) -> anyhow::Result<()> {
        if self.stop.requested() {
            bail!(INTERRUPTED);
        }
        Ok(())
    }
}

pub(super) fn print(results: &impl StageResults, json: bool) -> anyhow::Result<()> {
    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    for (what, how_much) in results.entries() {
        table.add_row([what, &how_much]);
    }
    let json = json.then(|| serde_json::to_string(results)).transpose()?;
    print_table(&table, json)
}

/// Prints the table, or with `json` the table to standard error and that line to standard output.
pub(super) fn print_table(table: &Table, json: Option<String>) -> anyhow::Result<()> {
    if let Some(json) = json {
        writeln!(std::io::stderr().lock(), "{table}")?;
        writeln!(std::io::stdout().lock(), "{json}")?;
    } else {
        writeln!(std::io::stdout().lock(), "{table}")?;
    }
    Ok(())
}
