//! Zenoh sessions of gate and relay, and the names of what they exchange.
//!
//! Zenoh carries bytes: it finds a way, connects again, encrypts, and separates messages. It may lose, repeat or
//! reorder whole messages when a connection breaks, and a `put` succeeds while nobody is connected. What makes chunks
//! arrive exactly once is in [`crate::uncommitted`] and [`crate::forwarding`].

use std::os::unix::process::CommandExt;
use std::process::Command;
use std::time::Duration;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::json;
use zenoh::{Config, Session, Wait};

use crate::endpoint::Endpoint;
use crate::files::KeyFile;
use crate::keys::HOST;

/// The environment variable with which Zenoh starts its threads, and the value for a single thread.
///
/// By default, Zenoh 1.10 reads a TLS connection in one thread and writes to it in another. rustls does not allow that,
/// and memory is corrupted (<https://github.com/eclipse-zenoh/zenoh/issues/2557>). In one thread the two cannot
/// coincide.
const THREADS: (&str, &str) = (
    "ZENOH_RUNTIME",
    "(app: (worker_threads: 1), acc: (handover: app), tx: (handover: app), rx: (handover: app), net: (handover: app))",
);

/// Gate or relay counts as cut off if nothing has come from it for this long.
pub(crate) const CUT_OFF_AFTER: Duration = Duration::from_secs(3);

/// How long gate and relay wait for news before they look at everything again.
pub(crate) const LONGEST_SLEEP: Duration = Duration::from_millis(20);

/// How often they refresh their connections to the processes of their host, which may have been restarted.
pub(crate) const REFRESH_INTERVAL: Duration = Duration::from_millis(50);

fn has_one_thread() -> bool {
    std::env::var(THREADS.0).is_ok_and(|value| value == THREADS.1)
}

/// Executes this program again, with the same arguments and in the same process, if Zenoh would otherwise use several
/// threads: only an environment variable decides that. A session can be opened afterwards. Call this before anything
/// else, because everything that the process has done is lost.
///
/// # Errors
/// When the program cannot be executed.
pub fn restart_with_one_thread() -> Result<(), NetworkError> {
    if has_one_thread() {
        return Ok(());
    }
    let mut arguments = std::env::args_os();
    let mut command = Command::new("/proc/self/exe");
    if let Some(name) = arguments.next() {
        command.arg0(name);
    }
    let cause = command.args(arguments).env(THREADS.0, THREADS.1).exec();
    Err(NetworkError {
        action: "be started",
        cause: cause.to_string(),
    })
}

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

/// The query with which a host asks to be admitted to the run; `*` for any run.
pub(crate) fn join(run_id: &str) -> String {
    format!("shoal/{run_id}/join")
}

/// The query for a policy that the host does not have.
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

/// Acknowledgements for a host.
pub(crate) fn acknowledgements(run_id: &str, host: u64) -> String {
    // `marks` belongs to the wire format, whose number another word would change.
    format!("shoal/{run_id}/down/{host}/marks")
}

/// A session that waits for others at this endpoint. With a key, only hosts with the run's key are let in, and they may
/// do nothing but join, send chunks and reports, and receive acknowledgements and policies.
///
/// # Errors
/// When the endpoint is taken, or the key cannot be used.
pub fn listen(endpoint: &Endpoint, key: Option<&KeyFile>) -> Result<Session, NetworkError> {
    let mut settings = vec![
        ("listen/endpoints", json!([endpoint])),
        ("transport/unicast/max_sessions", json!(10_000)),
        ("transport/unicast/accept_pending", json!(10_000)),
    ];
    if let Some(key) = key {
        settings.push((
            "transport/link/tls",
            json!({
                "root_ca_certificate_base64": STANDARD.encode(&key.authority),
                "listen_certificate_base64": STANDARD.encode(&key.certificate),
                "listen_private_key_base64": STANDARD.encode(key.private_key()),
                "enable_mtls": true,
            }),
        ));
        settings.push(("access_control", access(&key.run_id)));
    }
    open(&settings, "listen")
}

/// What hosts may do. Everything else is denied.
fn access(run_id: &str) -> serde_json::Value {
    let up = format!("shoal/{run_id}/up/**");
    let down = format!("shoal/{run_id}/down/**");
    let questions = [join(run_id), policy(run_id)];
    let rule = |id: &str, flow: &str, messages: &[&str], keys: &[String]| json!({ "id": id, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys });
    let rules = [
        rule("send", "ingress", &["put"], std::slice::from_ref(&up)),
        rule("ask", "ingress", &["query"], &questions),
        rule(
            "listen",
            "ingress",
            &["declare_subscriber"],
            std::slice::from_ref(&down),
        ),
        rule("acknowledgements", "egress", &["put"], &[down]),
        rule("answers", "egress", &["reply"], &questions),
        rule("receive", "egress", &["declare_subscriber"], &[up]),
        rule("be-asked", "egress", &["declare_queryable"], &questions),
    ];
    let names: Vec<_> = rules.iter().map(|rule| rule["id"].clone()).collect();
    json!({
        "enabled": true,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{ "id": "hosts", "cert_common_names": [HOST] }],
        "policies": [{ "rules": names, "subjects": ["hosts"] }],
    })
}

/// A session with the gate at this endpoint. It connects as soon as the gate is there, now and after every
/// interruption.
///
/// # Errors
/// When the key cannot be used.
pub fn connect(endpoint: &Endpoint, key: Option<&KeyFile>) -> Result<Session, NetworkError> {
    let mut settings = vec![
        ("connect/endpoints", json!([endpoint])),
        ("listen/endpoints", json!([])),
        ("connect/timeout_ms", json!(-1)),
        ("connect/exit_on_failure", json!(false)),
        (
            "connect/retry",
            json!({ "period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2 }),
        ),
    ];
    if let Some(key) = key {
        settings.push((
            "transport/link/tls",
            json!({
                "root_ca_certificate_base64": STANDARD.encode(&key.authority),
                "connect_certificate_base64": STANDARD.encode(&key.certificate),
                "connect_private_key_base64": STANDARD.encode(key.private_key()),
                "enable_mtls": true,
                // The authority has signed nothing but the gate of this run, whatever its host is called.
                "verify_name_on_connect": false,
            }),
        ));
    }
    open(&settings, "connect")
}

fn open(settings: &[(&str, serde_json::Value)], action: &'static str) -> Result<Session, NetworkError> {
    if !has_one_thread() {
        let cause = format!("{} must be {}", THREADS.0, THREADS.1);
        return Err(NetworkError { action, cause });
    }
    let mut config = Config::default();
    let common = [
        // In Zenoh's client mode, a session would not open before it is connected.
        ("mode", json!("peer")),
        // Nothing but the endpoint is ever contacted.
        ("scouting/multicast/enabled", json!(false)),
        ("scouting/gossip/enabled", json!(false)),
        // A host that vanishes is noticed after this many milliseconds.
        ("transport/link/tx/lease", json!(3000)),
        // Acknowledgements must not wait in the kernel behind a policy.
        ("transport/link/tcp/so_sndbuf", json!(65536)),
    ];
    for (key, value) in common.iter().chain(settings) {
        config
            .insert_json5(key, &value.to_string())
            .map_err(failed("be configured"))?;
    }
    zenoh::open(config).wait().map_err(failed(action))
}
