//! The free run: takes chunks as they come and updates as often as they allow.

use std::time::{Duration, Instant};

use shoal_common::exit::Exit;
use shoal_common::report::Activity;

use super::evaluation_wait::EvaluationWait;
use super::learner::Learner;
use super::ratio::Ratio;
use super::settings::LearnerError;

/// Updates from one publication to the next. Publishing copies the actor's weights once: about a thirtieth of an update.
const PUBLISH_EVERY: u64 = 4;

/// Chunks of an actor that are taken in before updates get their turn.
const CHUNKS_AT_ONCE: u32 = 8;

/// How long an idle learner sleeps before it looks after its connections.
const NAP: Duration = Duration::from_millis(50);

/// How long the evaluator may take over the last policy. Only a learner can give it to an evaluator that has come since.
const LAST_EVALUATION: Duration = Duration::from_secs(5);

pub(crate) fn run(learner: &mut Learner<'_>) -> Result<(), Exit<LearnerError>> {
    let ratio = Ratio::from(&learner.settings.config.replay);
    let every = Duration::from_secs_f64(learner.settings.config.checkpoint.every_seconds);
    let mut saved = Instant::now();
    // After a crash the replay is ahead of the checkpoint: those rows count.
    learner.count_rows(learner.replay.head());
    loop {
        if learner.stop.requested() {
            return Err(Exit::Stopped);
        }
        learner.connect_new_actors()?;
        let updates = learner.updates();
        // A power loss may leave a replay of many rows without one that can be read: new ones have to come first.
        let drained = learner.intake.drain(&mut learner.replay, CHUNKS_AT_ONCE, |replay| {
            !replay.rows().is_empty() && ratio.is_behind(replay.head(), updates)
        })?;
        learner.count_rows(learner.replay.head());

        if updates < ratio.allowed(learner.rows) && !learner.replay.rows().is_empty() {
            learner.update()?;
            if learner.updates().is_multiple_of(PUBLISH_EVERY) {
                learner.publish()?;
            }
            learner.tell(Activity::Working);
        } else if learner.has_all_rows() {
            learner.publish()?;
            learner.announce();
            return EvaluationWait::new(learner)?.wait(learner, Some(LAST_EVALUATION));
        } else {
            let activity = if learner.rows < ratio.warmup {
                Activity::WaitingForPeer
            } else {
                Activity::WaitingForRatio
            };
            if !drained {
                learner.listener.wait(NAP)?;
            }
            learner.look_after(activity)?;
        }
        if saved.elapsed() >= every {
            learner.save()?;
            saved = Instant::now();
        }
    }
}
