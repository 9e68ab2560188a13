//! `shoal status`: the status of a run.

use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use comfy_table::presets::NOTHING;
use comfy_table::{CellAlignment, Table};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde::Serialize;
use shoal_common::channel::control::{HostStatus, RoleState, RunStatus};
use shoal_common::message::{one_line, say};
use shoal_run::client::RunClient;
use shoal_run::numbers::thousands;
use shoal_run::status::saved_status;

use crate::status_table::{HOST_COLUMNS, ROLE_COLUMNS, host_cells, progress, role_cells, waiting};

#[derive(Args, Clone, Debug)]
pub(crate) struct StatusArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
    /// Repeat every second until the run ends.
    #[arg(long)]
    pub(crate) watch: bool,
}

/// Time between two requests with `--watch`.
const INTERVAL: Duration = Duration::from_secs(1);

/// The exit code if the run is not running.
const NOT_RUNNING: u8 = 3;

/// The output of `--json`.
#[derive(Serialize)]
struct StatusJson<'a> {
    running: bool,
    #[serde(flatten)]
    status: &'a RunStatus,
}

/// Shows the run's status, once or until it ends.
pub(crate) fn run(args: &StatusArgs) -> anyhow::Result<ExitCode> {
    let client = RunClient::open(&args.run)?;
    let Some(mut status) = client.status()? else {
        return show_saved(&args.run, args.json, &client);
    };
    if !args.watch {
        show(args, &status, &mut std::io::stdout().lock())?;
        return Ok(ExitCode::SUCCESS);
    }
    let screen = screen();
    // Why there was no answer, if it was said already.
    let mut silence = None;
    loop {
        if args.json || !std::io::stdout().is_terminal() {
            show(args, &status, &mut std::io::stdout().lock())?;
        } else {
            screen.set_message(table(&status));
        }
        std::thread::sleep(INTERVAL);
        match client.status() {
            Ok(Some(newer)) => (status, silence) = (newer, None),
            Ok(None) => break,
            // A launcher that is stopped, or busy, may answer later.
            Err(error) if client.run.is_running().unwrap_or(false) => {
                let line = one_line(error);
                if silence.as_ref() != Some(&line) {
                    screen.suspend(|| say(&line));
                    silence = Some(line);
                }
            }
            Err(error) => return Err(error),
        }
    }
    screen.finish_and_clear();
    show_saved(&args.run, args.json, &client)?;
    Ok(ExitCode::SUCCESS)
}

/// Shows the status of a run that is not running, by its files.
pub(super) fn show_saved(run: &Path, json: bool, client: &RunClient) -> anyhow::Result<ExitCode> {
    // The configuration is read again: the run may have been scaled or extended since it was opened.
    let status = saved_status(&client.run.config()?, &client.run)?;
    let mut stdout = std::io::stdout().lock();
    let here = run.display();
    if json {
        let printed = StatusJson {
            running: false,
            status: &status,
        };
        writeln!(stdout, "{}", serde_json::to_string(&printed)?)?;
    } else if !status.finished {
        writeln!(
            stdout,
            "nothing runs in {here}; {}; to continue: shoal resume {here}",
            progress(&status)
        )?;
    } else {
        writeln!(stdout, "nothing runs in {here}; {}: finished", progress(&status))?;
    }
    Ok(ExitCode::from(NOT_RUNNING))
}

fn show(args: &StatusArgs, status: &RunStatus, to: &mut impl Write) -> anyhow::Result<()> {
    if args.json {
        let printed = StatusJson { running: true, status };
        writeln!(to, "{}", serde_json::to_string(&printed)?)?;
    } else {
        writeln!(to, "{}", table(status))?;
    }
    Ok(())
}

/// An area of the terminal that is redrawn each time.
fn screen() -> ProgressBar {
    let screen = ProgressBar::with_draw_target(None, ProgressDrawTarget::stdout());
    if let Ok(style) = ProgressStyle::with_template("{msg}") {
        screen.set_style(style);
    }
    screen
}

fn table(status: &RunStatus) -> String {
    let mut table = Table::new();
    table.load_style(NOTHING);
    table.set_header(ROLE_COLUMNS);
    table.add_rows(status.roles.iter().map(role_cells));
    for column in [1, 3, 4, 5, 6] {
        if let Some(column) = table.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    let hosts = match &status.hosts[..] {
        [] => String::new(),
        hosts => format!("\n\n{}", table_of_hosts(hosts)),
    };
    let evaluated = status
        .eval_return_mean
        .map_or_else(String::new, |mean| format!(", eval {mean:.2}"));
    let starts = status.roles.iter().any(|role| role.state == RoleState::Starting);
    let waiting = if starts { "starting" } else { waiting(status) };
    format!(
        "{}, {} rows{evaluated}\n{:.0} updates/s, {:.0} steps/s, ratio {:.2} of {:.2}; {waiting}\n\n{table}{hosts}",
        progress(status),
        thousands(status.replay_rows),
        status.updates_per_second,
        status.env_steps_per_second,
        status.ratio,
        status.updates_per_step,
    )
}

fn table_of_hosts(hosts: &[HostStatus]) -> Table {
    let mut table = Table::new();
    table.load_style(NOTHING);
    table.set_header(HOST_COLUMNS);
    table.add_rows(hosts.iter().map(host_cells));
    for column in 2..HOST_COLUMNS.len() {
        if let Some(column) = table.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    table
}
