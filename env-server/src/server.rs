//! The environment server's loop: answers one actor's requests by stepping its environments.

use shoal_base::report::Activity;
use shoal_base::stop::Stop;
use shoal_channel::environment::{Ask, EnvironmentPort};
use shoal_channel::{ChannelError, HeartbeatSender};

use crate::vector::{Start, VectorEnvironment};

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
        let refused = match request.ask() {
            Some(ask @ (Ask::Reset | Ask::ResetToTraining | Ask::ResetToEvaluation)) => {
                let first = request.episode();
                let episodes = vec![first; environments.count()];
                let start = match ask {
                    Ask::ResetToTraining => Start::Episodes(&episodes),
                    Ask::ResetToEvaluation => Start::Evaluation {
                        seed,
                        first,
                        episodes: request.episodes(),
                    },
                    _ => Start::Next,
                };
                started = true;
                heartbeat.begin_work();
                request
                    .answer(|_, blocks| environments.reset(start, blocks.observations))?
                    .err()
            }
            Some(Ask::Step) if started => {
                heartbeat.begin_work();
                let refused = request
                    .answer(|actions, blocks| environments.step(actions, blocks))?
                    .err();
                heartbeat.count(environments.count() as u64);
                heartbeat.beat(Activity::Working);
                refused
            }
            Some(Ask::Snapshot) if started => request.answer_snapshot(|words| environments.snapshot(words))?.err(),
            Some(Ask::Step | Ask::Snapshot) => {
                request.not_started()?;
                None
            }
            Some(Ask::Restore) => {
                let words = request.words();
                let refused = request
                    .answer(|_, blocks| environments.restore(&words, blocks.observations))?
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
