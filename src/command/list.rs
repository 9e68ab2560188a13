//! `shoal list`: the runs in a directory.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Args;
use comfy_table::presets::NOTHING;
use comfy_table::{CellAlignment, Table};
use serde::Serialize;
use shoal_run::numbers::thousands;
use shoal_run::suite::Suite;

use crate::listing::{ListedRun, runs_in};

#[derive(Args, Clone, Debug)]
pub(crate) struct ListArgs {
    /// Directory that contains the runs.
    #[arg(default_value = "runs")]
    pub(crate) directory: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// The output of `--json`.
#[derive(Serialize)]
struct ListJson<'a> {
    directory: &'a Path,
    runs: &'a [ListedRun],
    suites: &'a [ListedSuite],
}

/// A suite in the directory.
#[derive(Serialize)]
struct ListedSuite {
    path: PathBuf,
    /// The number of its runs, and how many of them have begun.
    runs: usize,
    begun: usize,
}

/// Lists the runs directly in the directory.
pub(crate) fn run(args: &ListArgs) -> anyhow::Result<()> {
    let directory = &args.directory;
    if !directory.is_dir() {
        bail!(
            "there is no directory {}: name the one that contains the runs, or start a run with `shoal train`",
            directory.display()
        );
    }
    let runs: Vec<PathBuf> =
        runs_in(directory).with_context(|| format!("cannot read the directory {}", directory.display()))?;
    let runs: Vec<ListedRun> = runs.iter().map(|run| ListedRun::new(run)).collect();
    let suites = suites_in(directory).with_context(|| format!("cannot read the directory {}", directory.display()))?;
    let mut stdout = std::io::stdout().lock();
    if args.json {
        let printed = ListJson {
            directory,
            runs: &runs,
            suites: &suites,
        };
        writeln!(stdout, "{}", serde_json::to_string(&printed)?)?;
        return Ok(());
    }
    if runs.is_empty() {
        writeln!(stdout, "no runs in {}", directory.display())?;
    } else {
        writeln!(stdout, "{}", table(&runs))?;
        for run in &runs {
            if let Some(reason) = &run.reason {
                writeln!(stdout, "{}: {reason}", run.name)?;
            }
        }
    }
    for ListedSuite { path, runs, begun } in &suites {
        let here = path.display();
        writeln!(
            stdout,
            "{here}: a suite of {runs} runs, {begun} of them begun; to list them: shoal list {here}"
        )?;
    }
    Ok(())
}

/// The suites in a directory, by name. A suite that cannot be read is left out.
fn suites_in(directory: &Path) -> std::io::Result<Vec<ListedSuite>> {
    let mut suites = Vec::new();
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        if let Ok(Some(suite)) = Suite::read(&path) {
            suites.push(ListedSuite {
                runs: suite.trials.len(),
                begun: suite.runs(&path).len(),
                path,
            });
        }
    }
    suites.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(suites)
}

fn table(runs: &[ListedRun]) -> Table {
    let mut table = Table::new();
    table.load_style(NOTHING);
    table.set_header([
        "run",
        "state",
        "environment",
        "algorithm",
        "steps",
        "of",
        "best return",
        "final return",
    ]);
    for run in runs {
        let returned = |number: Option<f64>| number.map_or_else(String::new, |number| format!("{number:.2}"));
        let number = |number: Option<u64>| number.map_or_else(String::new, thousands);
        let (done, all) = match (run.episodes, run.episodes_limit) {
            (Some(episodes), Some(limit)) => (Some(episodes), format!("{} episodes", thousands(limit))),
            _ => (run.env_steps, number(run.steps)),
        };
        let row = [
            run.name.as_str(),
            run.state.name(),
            &run.environment,
            &run.algorithm,
            &number(done),
            &all,
            &returned(run.best_return),
            &returned(run.final_return),
        ];
        table.add_row(row);
    }
    for column in [4, 6, 7] {
        if let Some(column) = table.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table
}
