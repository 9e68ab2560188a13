//! The free run: takes chunks as they arrive and updates as often as the ratio allows.

use std::time::{Duration, Instant};

use shoal_common::exit::Exit;
use shoal_common::role::Activity;

use super::error::LearnerError;
use super::evaluation_wait::EvaluationWait;
use super::learner::{CHUNKS_AT_ONCE, Learner, would_lose_rows};

/// Updates between two publications of the policy. Publishing copies the policy's weights once, which takes about a
/// thirtieth of an update's time.
const PUBLISH_EVERY: u64 = 4;

/// How long an idle learner sleeps before it refreshes its connections.
const IDLE_WAIT: Duration = Duration::from_millis(50);

/// How long the learner waits for the evaluation of the last policy. A restarted evaluator can get that policy only
/// from a live learner.
const LAST_EVALUATION_TIMEOUT: Duration = Duration::from_secs(5);

pub(crate) fn run(learner: &mut Learner<'_>) -> Result<(), Exit<LearnerError>> {
    let config = &learner.settings.config;
    let save_interval = Duration::from_secs_f64(config.checkpoint.every_seconds);
    let mut saved_at = Instant::now();
    // After a crash the replay is ahead of the checkpoint. Those rows count.
    learner.advance_to(learner.replay.head());
    loop {
        if learner.stop.requested() {
            return Err(Exit::Stopped);
        }
        learner.connect_new_actors()?;
        let updates = learner.updates();
        // After the last episode no more rows are taken: a slow learner would never make all the updates that they
        // allow.
        let took_any = !learner.has_all_steps()
            // After a power loss the replay may have no readable row, although it had many. Then new rows come first.
            && learner.intake.take_in_turn(&mut learner.replay, CHUNKS_AT_ONCE, |replay| {
                let is_behind = config.replay.learner_is_behind(replay.head(), updates);
                would_lose_rows(config, replay, updates) || (!replay.rows().is_empty() && is_behind)
            })?;
        learner.advance_to(learner.replay.head());

        if updates < config.replay.allowed_updates(learner.env_steps) && !learner.replay.rows().is_empty() {
            learner.update()?;
            // One call may make several updates.
            if learner.updates() / PUBLISH_EVERY > updates / PUBLISH_EVERY {
                learner.publish()?;
            }
            learner.report_activity(Activity::Working);
        } else if learner.has_all_steps() {
            learner.publish()?;
            learner.notify_all();
            return EvaluationWait::new(learner)?.wait(learner, Some(LAST_EVALUATION_TIMEOUT));
        } else {
            let activity = if learner.env_steps < config.replay.ratio_start() {
                Activity::WaitingForPeer
            } else {
                Activity::WaitingForRatio
            };
            if !took_any {
                learner.listener.wait(IDLE_WAIT)?;
            }
            learner.refresh_connections(activity)?;
        }
        if saved_at.elapsed() >= save_interval {
            learner.save()?;
            saved_at = Instant::now();
        }
    }
}
