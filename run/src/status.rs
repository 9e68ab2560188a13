//! The status of a run that is not running, read from its directory.

use shoal_common::channel::control::RunStatus;
use shoal_common::commit::{CommitReader, OpenError};
use shoal_common::config::Config;
use shoal_common::evaluator_state::EvaluatorState;
use shoal_common::run_dir::RunDir;
use shoal_learner::process::checkpoint::Checkpoints;

use crate::records::outcome::{RunOutcome, RunState};
use crate::records::recorder::read_evaluations;

/// The status that a learner would continue from, by the run's files.
///
/// # Errors
/// When they cannot be read.
pub fn saved_status(config: &Config, run: &RunDir) -> anyhow::Result<RunStatus> {
    let counters = Checkpoints::new(&run.checkpoints(), config.fingerprint())
        .load_newest()?
        .map(|loaded| loaded.checkpoint.counters)
        .unwrap_or_default();
    let mut status = RunStatus {
        env_steps: counters.rows,
        steps: config.run.steps,
        episodes: counters.episodes,
        episodes_limit: config.run.episodes,
        updates: counters.updates,
        replay_rows: replay_rows(run)?,
        actors: config.actors.count,
        updates_per_step: config.replay.updates_per_step,
        policy_version: counters.policy_version,
        eval_return_mean: read_evaluations(&run.evaluations())?
            .last()
            .map(|last| last.return_mean),
        ..Default::default()
    };
    status.ratio = config.replay.ratio(status.updates, status.env_steps).unwrap_or(0.0);
    status.finished = is_finished(config, run, &status)?;
    Ok(status)
}

/// Whether a run without a launcher has done everything. A launcher that was killed or stopped after the last step may
/// have left updates or evaluations undone.
fn is_finished(config: &Config, run: &RunDir, status: &RunStatus) -> anyhow::Result<bool> {
    if !config.run.has_all_steps(status.env_steps, status.episodes) {
        return Ok(false);
    }
    if let Some(outcome) = RunOutcome::read(run)? {
        return Ok(outcome.state == RunState::Finished);
    }
    // Earlier versions wrote no outcome.
    Ok(status.updates >= config.replay.allowed_updates(status.env_steps))
}

/// Rows committed to a run's replay; 0 if it has none yet.
pub fn replay_rows(run: &RunDir) -> Result<u64, OpenError> {
    let commits = CommitReader::open_if_ready(&run.replay_file())?;
    Ok(commits.map_or(0, |commits| commits.rows()))
}

/// The evaluation period of the policy that was evaluated last, by the evaluator's state and the run's records. Earlier
/// versions saved no evaluator state.
///
/// # Errors
/// When these files cannot be read.
pub fn evaluated_period(config: &Config, run: &RunDir) -> anyhow::Result<Option<u64>> {
    let state = EvaluatorState::read(&run.evaluator_state())?;
    let recorded = read_evaluations(&run.evaluations())?;
    let steps = state.last().map(|last| last.env_steps);
    let steps = steps.into_iter().chain(recorded.iter().map(|row| row.env_steps)).max();
    Ok(steps.map(|steps| config.evaluation.period(steps)))
}
