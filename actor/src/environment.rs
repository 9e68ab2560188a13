//! The environment server of an actor or of the evaluator: connecting to it, and what follows an invalid answer.

use std::time::{Duration, Instant};

use shoal_common::channel::environment::EnvironmentClient;
use shoal_common::channel::{ChannelError, Domain, HeartbeatSender, Listener};
use shoal_common::exit::Exit;
use shoal_common::space::EnvironmentSpec;
use shoal_common::stop::Stop;

use crate::error::ActorError;

/// The end of the log line about an invalid answer of an environment server. The launcher looks for it.
pub const EPISODES_DROPPED: &str = "its episodes are given up";

/// How long an actor waits after an invalid answer before it begins new episodes.
const PAUSE_AFTER_FAULT: Duration = Duration::from_millis(50);

/// Connects to environment server `index` and checks that it serves the environments of the run's configuration.
pub(crate) fn connect(
    domain: &Domain,
    listener: &Listener,
    index: u32,
    spec: &EnvironmentSpec,
    envs: usize,
    stop: &Stop,
) -> Result<EnvironmentClient, Exit<ActorError>> {
    let client = EnvironmentClient::open(domain, index, spec, envs, stop.clone())?;
    let (served, served_envs) = client.spec(listener, || ()).map_err(Exit::convert)?;
    let counts = || (served_envs != envs).then(|| format!("it has {served_envs} environments instead of {envs}"));
    match served.difference(spec).or_else(counts) {
        Some(difference) => Err(Exit::Failed(ActorError::Server { index, difference })),
        None => Ok(client),
    }
}

/// Logs an invalid answer of an environment server and pauses; the caller must then begin new episodes. Without the
/// pause, an environment that always answers like this would fill the log before the launcher ends the run.
pub(crate) fn after_fault(
    error: &ChannelError,
    heartbeat: &mut HeartbeatSender,
    listener: &Listener,
    stop: &Stop,
) -> Result<(), Exit<ChannelError>> {
    tracing::warn!("{error}; {EPISODES_DROPPED}");
    heartbeat.count_fault();
    let since = Instant::now();
    while since.elapsed() < PAUSE_AFTER_FAULT {
        if stop.requested() {
            return Err(Exit::Stopped);
        }
        listener.wait(PAUSE_AFTER_FAULT)?;
    }
    Ok(())
}
