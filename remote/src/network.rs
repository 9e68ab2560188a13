//! Zenoh sessions of gate and relay, and the names of what they exchange.
//!
//! Zenoh carries bytes: it finds a way, connects again, and separates messages. It may lose, repeat or reorder whole
//! messages when a connection breaks, and a `put` succeeds while nobody is connected. What makes chunks arrive exactly
//! once is in [`crate::unconfirmed`] and [`crate::forwarding`].

use zenoh::{Config, Session, Wait};

use crate::endpoint::Endpoint;

/// Zenoh could not do something.
#[derive(Debug, thiserror::Error)]
#[error("the network cannot {action}: {cause}")]
pub struct NetworkError {
    action: &'static str,
    cause: String,
}

/// For `map_err`.
pub(crate) fn failed(action: &'static str) -> impl Fn(zenoh::Error) -> NetworkError {
    move |cause| NetworkError {
        action,
        cause: cause.to_string(),
    }
}

/// The query with which a host asks to be admitted to the run.
pub(crate) fn join(run_id: &str) -> String {
    format!("shoal/{run_id}/join")
}

/// The query for a policy that is newer than the one in the query.
pub(crate) fn policy(run_id: &str) -> String {
    format!("shoal/{run_id}/policy")
}

/// Chunks of a host; `*` for all hosts.
pub(crate) fn chunks(run_id: &str, host: &str) -> String {
    format!("shoal/{run_id}/up/{host}/chunks")
}

/// Reports of a host.
pub(crate) fn reports(run_id: &str, host: &str) -> String {
    format!("shoal/{run_id}/up/{host}/reports")
}

/// Marks for a host.
pub(crate) fn marks(run_id: &str, host: u64) -> String {
    format!("shoal/{run_id}/down/{host}/marks")
}

/// A session that waits for others at this endpoint.
pub(crate) fn listen(endpoint: Endpoint) -> Result<Session, NetworkError> {
    let ours = [
        ("mode", "\"peer\"".into()),
        ("listen/endpoints", format!("[\"{endpoint}\"]")),
        ("transport/unicast/max_sessions", "10000".into()),
        ("transport/unicast/accept_pending", "10000".into()),
    ];
    open(&ours, "listen")
}

/// A session with the gate at this endpoint. It connects as soon as the gate is there, now and after every interruption.
pub(crate) fn connect(endpoint: Endpoint) -> Result<Session, NetworkError> {
    let ours = [
        // A client would not begin before it is connected.
        ("mode", "\"peer\"".into()),
        ("connect/endpoints", format!("[\"{endpoint}\"]")),
        ("listen/endpoints", "[]".into()),
        ("connect/timeout_ms", "-1".into()),
        ("connect/exit_on_failure", "false".into()),
        (
            "connect/retry",
            "{ period_init_ms: 100, period_max_ms: 1000, period_increase_factor: 2 }".into(),
        ),
    ];
    open(&ours, "connect")
}

fn open(ours: &[(&str, String)], action: &'static str) -> Result<Session, NetworkError> {
    let mut config = Config::default();
    let common = [
        // Nothing but the endpoint is ever contacted.
        ("scouting/multicast/enabled", "false".into()),
        ("scouting/gossip/enabled", "false".into()),
        // A host that vanishes is noticed after this many milliseconds.
        ("transport/link/tx/lease", "3000".into()),
        // Marks must not wait in the kernel behind a policy.
        ("transport/link/tcp/so_sndbuf", "65536".into()),
    ];
    for (key, value) in common.iter().chain(ours) {
        config.insert_json5(key, value).map_err(failed("be configured"))?;
    }
    zenoh::open(config).wait().map_err(failed(action))
}
