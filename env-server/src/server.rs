//! The environment server's loop: answers one actor's requests by stepping its environments.

use shoal_base::role::Activity;
use shoal_base::stop::Stop;
use shoal_channel::environment::{EnvironmentPort, RequestKind};
use shoal_channel::{ChannelError, HeartbeatSender};

use crate::vector::{Reset, VectorEnvironment};

/// Answers requests until `stop`. `seed` determines the evaluation episodes.
///
/// # Errors
/// When the channel fails. An invalid request is refused and logged; it is not an error.
pub fn serve(
    environments: &mut VectorEnvironment,
    port: &EnvironmentPort,
    seed: u64,
    mut heartbeat: HeartbeatSender,
    stop: &Stop,
) -> Result<(), ChannelError> {
    let mut started = false;
    heartbeat.beat(Activity::WaitingForPeer);
    loop {
        let request = match port.next(stop, || heartbeat.beat(Activity::WaitingForPeer)) {
            Ok(request) => request,
            Err(exit) => return exit.into_result(),
        };
        let refused = match request.kind() {
            Some(kind @ (RequestKind::Reset | RequestKind::ResetToTraining | RequestKind::ResetToEvaluation)) => {
                let first = request.episode();
                let episodes = vec![first; environments.count()];
                let reset = match kind {
                    RequestKind::ResetToTraining => Reset::Episodes(&episodes),
                    RequestKind::ResetToEvaluation => Reset::Evaluation {
                        seed,
                        first,
                        episodes: request.episodes(),
                    },
                    _ => Reset::Next,
                };
                started = true;
                heartbeat.begin_work();
                request
                    .respond(|_, blocks| environments.reset(reset, blocks.observations))?
                    .err()
            }
            Some(RequestKind::Step) if started => {
                heartbeat.begin_work();
                let refused = request
                    .respond(|actions, blocks| environments.step(actions, blocks))?
                    .err();
                heartbeat.count(environments.count() as u64);
                heartbeat.beat(Activity::Working);
                refused
            }
            Some(RequestKind::Snapshot) if started => request
                .respond_with_snapshot(|words| environments.snapshot(words))?
                .err(),
            Some(RequestKind::Step | RequestKind::Snapshot) => {
                request.not_started()?;
                None
            }
            Some(RequestKind::Restore) => {
                let words = request.words();
                let refused = request
                    .respond(|_, blocks| environments.restore(&words, blocks.observations))?
                    .err();
                started |= refused.is_none();
                refused
            }
            _ => {
                request.refuse()?;
                None
            }
        };
        if let Some(error) = refused {
            tracing::error!("a request was refused: {error}");
        }
    }
}
