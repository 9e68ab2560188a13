//! The lockstep run: the same seed and actor count give the same bits with any timing.
//!
//! Round k takes chunk k of actor 0, 1, …, N − 1, all collected with policy version k − 1, does the updates they allow,
//! and publishes version k. A learner that continues from a checkpoint finds the rows of the rounds since then in the
//! replay, and repeats the same updates.

use shoal_common::algorithms::TransitionUse;
use shoal_common::channel::wait_for;
use shoal_common::exit::Exit;
use shoal_common::role::Activity;

use super::error::LearnerError;
use super::evaluation_wait::EvaluationWait;
use super::intake::IntakeError;
use super::learner::Learner;

pub(crate) fn run(learner: &mut Learner<'_>) -> Result<(), Exit<LearnerError>> {
    let mut evaluation_wait = EvaluationWait::new(learner)?;
    let config = &learner.settings.config;
    let (interval, replay_config) = (config.checkpoint.every_updates, &config.replay);
    // A run without updates saves only its first state, and needs no row again.
    let repeats_updates = replay_config.updates_per_step > 0.0;
    let needed = learner.env_steps.saturating_sub(config.replay.capacity);
    let is_lost = repeats_updates && learner.replay.rows().start > needed;
    if is_lost || learner.replay.head() < learner.env_steps {
        let path = learner.settings.run.replay_file();
        return Err(LearnerError::RowsLost { path, needed }.into());
    }
    if learner.updates() == 0 {
        learner.save()?;
    }
    learner.notify_all();
    evaluation_wait.wait(learner, None)?;
    while !learner.has_all_steps() {
        let (before, updates) = (learner.env_steps, learner.updates());
        let mut rows = before;
        for actor in 0..learner.intake.actor_count() {
            rows = await_chunk(learner, actor, rows)?;
        }
        // Only after all chunks have arrived, so that a round that is interrupted before that begins again.
        learner.advance_to(rows);
        while learner.updates() < replay_config.allowed_updates(learner.env_steps) {
            learner.update()?;
            learner.report_activity(Activity::Working);
        }
        learner.publish()?;
        learner.notify_all();
        evaluation_wait.wait(learner, None)?;
        if learner.updates() / interval > updates / interval {
            learner.save()?;
        }
        if learner.stop.requested() {
            return Err(Exit::Stopped);
        }
    }
    Ok(())
}

/// Waits until the replay has the actor's chunk of this round, which begins at row `first`. Returns the row after the
/// chunk.
fn await_chunk(learner: &mut Learner<'_>, actor: usize, first: u64) -> Result<u64, Exit<LearnerError>> {
    loop {
        if let Some(end) = end_of_chunk(learner, actor, first) {
            return Ok(end);
        }
        let Learner {
            listener,
            stop,
            intake,
            replay,
            publisher,
            heartbeat,
            ..
        } = learner;
        // The inner error is about the chunk, the outer one about the wait for it.
        let taken = wait_for(
            listener,
            stop,
            || match intake.take_from(actor, replay) {
                Err(IntakeError::Channel(error)) => Err(error),
                other => Ok(other.transpose()),
            },
            || {
                heartbeat.beat(Activity::WaitingForPeer);
                publisher.refresh_connections()
            },
        );
        taken.map_err(Exit::convert)??;
        learner.report_activity(Activity::Working);
    }
}

/// The row after the actor's chunk of this round, which begins at row `first`, if that chunk is in the replay. A chunk is
/// full, is one episode, or ends with the last environment step of the run.
fn end_of_chunk(learner: &Learner<'_>, actor: usize, first: u64) -> Option<u64> {
    let Learner { settings, replay, .. } = learner;
    let (config, steps) = (&settings.config, settings.config.run.steps);
    let head = replay.head();
    if head <= first {
        // After the last step no rows are taken, but the chunk is: if the run gets more steps, each actor must have sent
        // as many chunks as there were rounds.
        let is_taken = replay.committed(actor).last_chunk.sequence > learner.policy_version;
        return (first >= steps && is_taken).then_some(first);
    }
    let full = (first + config.chunk_rows() as u64).min(steps);
    if config.algorithm.properties().transition_use == TransitionUse::Episodes {
        let row = replay.layout().row;
        let last = (first..head.min(full)).find(|index| row.read(replay.row(*index)).last);
        return last.map(|last| last + 1).or((head >= full).then_some(full));
    }
    (head >= full).then_some(full)
}
