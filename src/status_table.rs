//! How `status` and `top` show a run: its progress, and the tables of its roles and hosts.

use shoal_common::channel::control::{HostState, HostStatus, RoleState, RoleStatus, RunStatus};
use shoal_run::numbers::thousands;

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

/// The columns of a table of roles.
pub(crate) const ROLE_COLUMNS: [&str; 7] = ["role", "pid", "state", "restarts", "rate", "policy", "lag"];

/// The cells of a role, in the order of [`ROLE_COLUMNS`].
pub(crate) fn role_cells(role: &RoleStatus) -> [String; 7] {
    let or_none = |number: Option<u64>| number.map_or_else(String::new, thousands);
    [
        format!("{} {}", role.role.name(), role.index),
        role.pid.map_or_else(String::new, |pid| pid.to_string()),
        state_name(role.state).into(),
        role.restarts.to_string(),
        format!("{:.0}/s", role.rate),
        or_none(role.policy_version),
        or_none(role.policy_lag),
    ]
}

/// The columns of a table of hosts.
pub(crate) const HOST_COLUMNS: [&str; 7] = ["host", "state", "actors", "rate", "resent", "round trip", "lag"];

/// The cells of a host, in the order of [`HOST_COLUMNS`].
pub(crate) fn host_cells(host: &HostStatus) -> [String; 7] {
    let state = match host.state {
        HostState::Connected => "connected".into(),
        HostState::CutOff => format!("cut off for {:.0} s", host.silent_seconds),
        HostState::Left => "has left".into(),
    };
    let actors = if host.wanted_actors == host.actors {
        host.actors.to_string()
    } else {
        format!("{} to {}", host.actors, host.wanted_actors)
    };
    let round_trip = host.round_trip_us;
    [
        host.name.clone(),
        state,
        actors,
        format!("{:.0}/s", host.rows_per_second),
        thousands(host.resent_chunks),
        round_trip.map_or_else(String::new, |time| format!("{:.1} ms", time as f64 / 1e3)),
        thousands(host.policy_lag),
    ]
}

/// Who waits for whom, in words.
pub(crate) fn waiting(status: &RunStatus) -> &str {
    let waiting = status.waiting.as_deref();
    waiting.map_or("nobody waits", |waiting| waiting.split(':').next().unwrap_or(waiting))
}

/// The state of a role in words.
fn state_name(state: RoleState) -> &'static str {
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
