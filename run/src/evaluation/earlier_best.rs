//! Evaluates the best policy of a run again if later policies are evaluated differently.

use shoal_common::config::Config;
use shoal_common::run_dir::LockedRun;

use crate::evaluation::{EpisodeSet, EvaluationSummary, SavedPolicy, evaluate_policy};
use crate::external_environment::GYMNASIUM;
use crate::external_environment::server_location::ServerLocation;
use crate::files::is_there;
use crate::signals::Interrupt;

/// The best policy's result before and after it was evaluated again.
#[derive(Clone, Debug, PartialEq)]
pub struct ReevaluatedPolicy {
    /// The mean return that `best.policy` had.
    pub before: f64,
    /// The result that it has now.
    pub now: EvaluationSummary,
}

/// Evaluates the best policy of a Gymnasium run of an earlier version again, once. In that version the seeds of
/// episodes could be above 2³¹, so half of its start states differ from those of later evaluations, and the returns
/// cannot be compared.
///
/// Such a run has no `server.json`, which came with the same version as the new seeds. This function writes that file,
/// so the next call finds nothing to do.
///
/// # Errors
/// When the policy cannot be read or written, the environment fails, a signal has arrived, or the run is no longer at
/// its place.
pub fn reevaluate_if_needed(
    run: &LockedRun,
    config: &Config,
    interrupt: &Interrupt,
) -> anyhow::Result<Option<ReevaluatedPolicy>> {
    if !config.environment.name.starts_with(GYMNASIUM) || is_there(&run.server_file())? {
        return Ok(None);
    }
    let evaluated = reevaluate_best(run, config, interrupt)?;
    if let Some(location) = ServerLocation::here(&config.environment.server)? {
        run.check()?;
        location.write(run)?;
    }
    Ok(evaluated)
}

/// Evaluates the best policy with the episodes that later policies will have; `None` if there is none yet.
///
/// # Errors
/// When the policy cannot be read or written, the environment fails, a signal has arrived, or the run is no longer at
/// its place.
pub fn reevaluate_best(
    run: &LockedRun,
    config: &Config,
    interrupt: &Interrupt,
) -> anyhow::Result<Option<ReevaluatedPolicy>> {
    let Some(best) = SavedPolicy::Best.read_if_any(run, config)? else {
        return Ok(None);
    };
    let episodes = EpisodeSet {
        count: config.evaluation.episodes,
        seed: config.run.seed,
    };
    let now = evaluate_policy(run, config, &best.parameters, episodes, interrupt, |_| ())?;
    // The episodes may have taken long: by now another run may be at its place.
    run.check()?;
    now.of_policy(&best).write(&run.best_policy())?;
    Ok(Some(ReevaluatedPolicy {
        before: best.return_mean,
        now,
    }))
}
