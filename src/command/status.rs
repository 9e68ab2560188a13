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
use shoal_common::channel::control::{HostState, HostStatus, RoleState, RunStatus};
use shoal_run::client::RunClient;
use shoal_run::numbers::thousands;
use shoal_run::status::saved_status;

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
struct Printed<'a> {
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
    loop {
        if args.json || !std::io::stdout().is_terminal() {
            show(args, &status, &mut std::io::stdout().lock())?;
        } else {
            screen.set_message(table(&status));
        }
        std::thread::sleep(INTERVAL);
        match client.status()? {
            Some(newer) => status = newer,
            None => break,
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
        let printed = Printed {
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
        let printed = Printed { running: true, status };
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

/// The run's progress in words.
pub(crate) fn progress(status: &RunStatus) -> String {
    let updates = thousands(status.updates);
    match status.episodes_limit {
        Some(limit) => format!(
            "{} of {} episodes, {} steps, {updates} updates",
            thousands(status.episodes),
            thousands(limit),
            thousands(status.env_steps)
        ),
        None => format!(
            "{} of {} steps, {updates} updates",
            thousands(status.env_steps),
            thousands(status.steps)
        ),
    }
}

fn table(status: &RunStatus) -> String {
    let mut table = Table::new();
    table.load_style(NOTHING);
    table.set_header(["role", "pid", "state", "restarts", "rate", "policy", "lag"]);
    for role in &status.roles {
        let or_none = |number: Option<u64>| number.map_or_else(String::new, thousands);
        table.add_row([
            format!("{} {}", role.role, role.index),
            role.pid.map_or_else(String::new, |pid| pid.to_string()),
            state_name(role.state).into(),
            role.restarts.to_string(),
            format!("{:.0}/s", role.rate),
            or_none(role.policy_version),
            or_none(role.policy_lag),
        ]);
    }
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

/// The columns of a table of hosts.
pub(crate) const HOST_COLUMNS: [&str; 7] = ["host", "state", "actors", "rate", "resent", "round trip", "lag"];

/// What a table says of a host, in the order of [`HOST_COLUMNS`].
pub(crate) fn host_cells(host: &HostStatus) -> [String; 7] {
    let state = match host.state {
        HostState::Connected => "connected".into(),
        HostState::CutOff => format!("cut off for {:.0} s", host.silent_seconds),
        HostState::Left => "has left".into(),
    };
    let round_trip = host.round_trip_us;
    [
        host.name.clone(),
        state,
        host.actors.to_string(),
        format!("{:.0}/s", host.rows_per_second),
        thousands(host.resent_chunks),
        round_trip.map_or_else(String::new, |time| format!("{:.1} ms", time as f64 / 1e3)),
        thousands(host.policy_lag),
    ]
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

/// Which role waits, and for what, in words.
pub(crate) fn waiting(status: &RunStatus) -> &str {
    let waiting = status.waiting.as_deref();
    waiting.map_or("nobody waits", |waiting| waiting.split(':').next().unwrap_or(waiting))
}

/// The state of a role in words.
pub(crate) fn state_name(state: RoleState) -> &'static str {
    match state {
        RoleState::Starting => "starting",
        RoleState::Working => "working",
        RoleState::WaitingForPeer => "waits for a peer",
        RoleState::WaitingForRatio => "waits (ratio)",
        RoleState::Silent => "silent (stopped?)",
        RoleState::Retiring => "retiring",
        RoleState::Ending => "ending",
        RoleState::Restarting => "restarting",
        RoleState::Done => "done",
    }
}
