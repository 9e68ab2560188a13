//! How far a run of a suite is and how good, read from its directory while it may be running.

use std::path::Path;

use crate::evaluation::SavedPolicy;
use crate::evaluation::final_evaluation::FinalEvaluation;
use crate::origin::Origin;
use crate::records::recorder::{read_evaluations, recorded};
use crate::status::replay_rows;
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

/// The share of its steps, or of its episodes, that a run has done. Steps are counted in the replay: the records are
/// half a second behind, and take longer to read. Initial rows do not count.
pub fn share_done(run: &Path) -> f64 {
    let of_steps = || {
        let run = RunDir::open(run).ok()?;
        let limits = run.config().ok()?.run;
        let origin = Origin::read(&run).ok()?;
        if limits.has_origin() && origin.is_none() {
            // They are being copied.
            return Some((0, limits.steps));
        }
        let inherited = origin.map_or(0, |origin| origin.rows());
        let rows = replay_rows(&run).ok()?;
        let without = |rows: u64| rows.saturating_sub(inherited);
        limits
            .episodes
            .is_none()
            .then_some((without(rows), without(limits.steps)))
    };
    let progress = of_steps().or_else(|| progress(run));
    progress.map_or(0.0, |(done, all)| done as f64 / all.max(1) as f64)
}

/// Whether a policy of the run that has learned something was evaluated.
pub fn is_evaluated(run: &Path) -> bool {
    returns(run).next().is_some()
}

/// The best return of a run's evaluations so far; −∞ if there is none.
pub fn best_return(run: &Path) -> f64 {
    returns(run)
        .filter(|mean| mean.is_finite())
        .fold(f64::NEG_INFINITY, f64::max)
}

/// The mean returns of a run's evaluations so far. Policies that have learned nothing do not count: they are the same
/// for all settings.
fn returns(run: &Path) -> impl Iterator<Item = f64> {
    let evaluations = RunDir::open(run)
        .ok()
        .and_then(|run| read_evaluations(&run.evaluations()).ok());
    let learned = evaluations
        .into_iter()
        .flatten()
        .filter(|evaluation| evaluation.updates > 0);
    learned.map(|evaluation| evaluation.return_mean)
}

/// What a run has done, and what it is to do: episodes if they limit it, otherwise environment steps.
pub fn progress(run: &Path) -> Option<(u64, u64)> {
    let run = RunDir::open(run).ok()?;
    let config: Config = run.config().ok()?;
    let (steps, episodes) = recorded(&run).ok()?.unwrap_or_default();
    Some(match config.run.episodes {
        Some(limit) => (episodes, limit),
        None => (steps, config.run.steps),
    })
}

/// The mean return of a finished run's best policy in its final evaluation.
pub fn final_return(run: &Path) -> Option<f64> {
    let run = RunDir::open(run).ok()?;
    let (steps, _) = recorded(&run).ok()?.unwrap_or_default();
    FinalEvaluation::read(&run, steps)
        .ok()??
        .of(SavedPolicy::Best)?
        .return_mean
}
