//! The lockstep run: the same seed and actor count give the same bits, whatever the timing.
//!
//! Round k takes chunk k of actor 0, 1, …, N − 1, all collected with policy version k − 1, does the updates they allow,
//! and publishes version k. A learner that goes on from a checkpoint finds the rows of the rounds since then in the
//! replay and does the same updates again.

use shoal_common::channel::reports::Reports;
use shoal_common::channel::{ChannelError, wait_for};
use shoal_common::report::{Activity, EvaluationReport};

use crate::intake::IntakeError;
use crate::learner::{Ended, Learner, LearnerError};

pub(crate) fn run(learner: &mut Learner<'_>) -> Result<(), Ended> {
    let evaluations = Reports::<EvaluationReport>::open(learner.domain)?;
    let interval = learner.settings.checkpoint.every_updates;
    let needed = learner.rows.saturating_sub(learner.settings.capacity);
    if learner.replay.rows().start > needed || learner.replay.head() < learner.rows {
        let path = learner.settings.replay.clone();
        return Err(LearnerError::RowsLost { path, needed }.into());
    }
    if learner.updates() == 0 {
        learner.save()?;
    }
    learner.announce();
    let judged = learner.settings.judged;
    await_evaluation(learner, &evaluations, judged)?;
    while learner.rows < learner.settings.steps {
        let (before, updates) = (learner.rows, learner.updates());
        let mut rows = before;
        for actor in 0..learner.intake.actors() {
            rows += (learner.settings.chunk.rows as u64).min(learner.settings.steps - rows);
            await_rows(learner, actor, rows)?;
        }
        // Only now: whoever is interrupted within a round goes on from its beginning.
        learner.rows = rows;
        while learner.updates() < learner.settings.ratio.allowed(learner.rows) {
            learner.update()?;
            learner.tell(Activity::Working);
        }
        learner.publish()?;
        learner.announce();
        let judged = Some(learner.settings.evaluation.period(before)).max(learner.settings.judged);
        await_evaluation(learner, &evaluations, judged)?;
        if learner.updates() / interval > updates / interval {
            learner.save()?;
        }
        if learner.stop.requested() {
            return Err(Ended::Stopped);
        }
    }
    Ok(())
}

/// Waits until the actor's chunk of this round is in the replay, which then has `rows` rows or more.
fn await_rows(learner: &mut Learner<'_>, actor: usize, rows: u64) -> Result<(), Ended> {
    while learner.replay.head() < rows {
        let Learner {
            bell,
            stop,
            intake,
            replay,
            publisher,
            pulse,
            ..
        } = learner;
        // The inner result is what is wrong with the chunk, the outer one what is wrong with waiting for it.
        let taken = wait_for(
            bell,
            stop,
            || match intake.take_from(actor, replay) {
                Err(IntakeError::Channel(error)) => Err(error),
                other => Ok(other.transpose()),
            },
            || {
                pulse.beat(Activity::WaitingForPeer);
                publisher.look_after()
            },
        )?;
        taken?;
        learner.tell(Activity::Working);
    }
    Ok(())
}

/// Waits until the policy just published is judged, if it is one that must be: the first after the period `judged`.
fn await_evaluation(
    learner: &mut Learner<'_>,
    evaluations: &Reports<EvaluationReport>,
    judged: Option<u64>,
) -> Result<(), Ended> {
    let evaluation = &learner.settings.evaluation;
    if judged.is_some_and(|judged| evaluation.period(learner.rows) <= judged) {
        return Ok(());
    }
    let version = learner.policy_version();
    let Learner {
        bell,
        stop,
        publisher,
        pulse,
        ..
    } = learner;
    wait_for(
        bell,
        stop,
        || -> Result<Option<()>, ChannelError> {
            while let Some(report) = evaluations.receive()? {
                if report.policy_version == version {
                    return Ok(Some(()));
                }
            }
            Ok(None)
        },
        || {
            pulse.beat(Activity::WaitingForPeer);
            publisher.look_after()
        },
    )?;
    Ok(())
}
