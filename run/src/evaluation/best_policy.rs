//! The policy that a finished run keeps as its best one. The best and the last policy are evaluated once more, and the
//! better one is kept.

use anyhow::Context;
use shoal_common::config::Config;
use shoal_common::numbers::are_finite;
use shoal_common::policy_file::PolicyFile;
use shoal_common::run_dir::{LockedRun, RunDir};

use crate::evaluation::final_evaluation::{FinalEvaluation, FinalPolicyResult};
use crate::evaluation::{EpisodeSet, EvaluationSummary, SavedPolicy, evaluate_policy};
use crate::signals::Interrupt;

/// A policy with its final evaluation.
#[derive(Clone, Debug, PartialEq)]
pub struct FinalResult {
    /// Which of the two it is now.
    pub policy: SavedPolicy,
    /// How it did.
    pub summary: EvaluationSummary,
}

/// A policy as it was before the choice.
struct Candidate {
    policy: SavedPolicy,
    file: PolicyFile,
    summary: EvaluationSummary,
}

/// Evaluates the best and the last policy of a run with `env_steps` environment steps. The better one is `best.policy`
/// afterwards. Records the results and returns them: first the kept policy's, then the last policy's if it was
/// evaluated. Calls `progress` with the policy and its finished episodes.
///
/// # Errors
/// When a policy cannot be read or evaluated, none has a finite return, a file cannot be written, a signal has arrived,
/// or the run is no longer at its place.
pub fn evaluate_and_keep_best(
    config: &Config,
    run: &LockedRun,
    env_steps: u64,
    interrupt: &Interrupt,
    mut progress: impl FnMut(SavedPolicy, u32),
) -> anyhow::Result<Vec<FinalResult>> {
    let (episodes, seed) = (config.evaluation.final_episodes, config.run.seed);
    let mut candidates = Vec::new();
    for policy in [SavedPolicy::Best, SavedPolicy::Last] {
        let Some(file) = policy.read_if_any(run, config)?.filter(is_finite) else {
            continue;
        };
        progress(policy, 0);
        let progress = |finished: u32| progress(policy, finished);
        let summary = evaluate_policy(
            run,
            config,
            &file.parameters,
            EpisodeSet { count: episodes, seed },
            interrupt,
            progress,
        )?;
        candidates.push(Candidate { policy, file, summary });
    }
    let kept = better(&candidates).context("no policy has a finite return")?;
    // The episodes may have taken long: by now another run may be at its place.
    run.check()?;
    if kept.policy == SavedPolicy::Last {
        kept.summary.of_policy(&kept.file).write(&run.best_policy())?;
    }
    let entry = |it: &Candidate| FinalPolicyResult::new(it.policy, (it.file.version, it.file.env_steps), &it.summary);
    let result = FinalEvaluation::new(seed, env_steps, candidates.iter().map(entry).collect(), kept.policy);
    result.write(run)?;
    let best = FinalResult {
        policy: SavedPolicy::Best,
        summary: kept.summary.clone(),
    };
    let last = candidates.iter().filter(|it| it.policy == SavedPolicy::Last);
    let last = last.map(|it| FinalResult {
        policy: SavedPolicy::Last,
        summary: it.summary.clone(),
    });
    Ok(std::iter::once(best).chain(last).collect())
}

/// The candidate with the greatest finite mean return; the first of equal ones, so that the last policy replaces the
/// best one only if it is better.
fn better(candidates: &[Candidate]) -> Option<&Candidate> {
    let mut kept: Option<&Candidate> = None;
    for candidate in candidates.iter().filter(|it| it.summary.return_mean.is_finite()) {
        if kept.is_none_or(|kept| candidate.summary.return_mean > kept.summary.return_mean) {
            kept = Some(candidate);
        }
    }
    kept
}

/// Keeps the last policy as the best one if there is no policy with a finite evaluation, so that the run has a policy
/// to use.
///
/// # Errors
/// When a policy cannot be read or written.
pub fn ensure_best_policy(config: &Config, run: &RunDir) -> anyhow::Result<()> {
    let best = SavedPolicy::Best.read_if_any(run, config)?;
    if best.is_some_and(|best| best.return_mean.is_finite()) {
        return Ok(());
    }
    if let Some(last) = SavedPolicy::Last.read_if_any(run, config)?.filter(is_finite) {
        last.write(&run.best_policy())?;
    }
    Ok(())
}

fn is_finite(file: &PolicyFile) -> bool {
    are_finite(&file.parameters)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::evaluation::rollout::policy_layout;
    use crate::testing::small;

    /// A run at this path with its last policy, and its configuration.
    fn run_with_last_policy(path: &Path) -> (Config, LockedRun) {
        let (mut config, parameters) = small("name = \"pendulum\"");
        config.evaluation.final_episodes = 2;
        let run = RunDir::create(path).unwrap();
        run.write_config(&config).unwrap();
        std::fs::create_dir(run.checkpoints()).unwrap();
        let last = PolicyFile {
            fingerprint: policy_layout(&config).unwrap().fingerprint(),
            version: 1,
            env_steps: 1,
            return_mean: f64::NAN,
            return_std: 0.0,
            episodes: 0,
            parameters,
        };
        last.write(&run.last_policy()).unwrap();
        (config, run.lock().unwrap())
    }

    #[test]
    fn a_best_policy_that_cannot_be_inspected_is_not_replaced() {
        let parent = tempfile::tempdir().unwrap();
        let (config, run) = run_with_last_policy(&parent.path().join("run"));
        // To follow it fails, also for root.
        std::os::unix::fs::symlink(run.best_policy(), run.best_policy()).unwrap();
        let kept = evaluate_and_keep_best(&config, &run, 1, &Interrupt::default(), |_, _| ());
        for error in [kept.unwrap_err(), ensure_best_policy(&config, &run).unwrap_err()] {
            assert!(error.to_string().contains("best.policy"), "{error}");
        }
        assert!(std::fs::symlink_metadata(run.best_policy()).unwrap().is_symlink());
        std::fs::remove_file(run.best_policy()).unwrap();
        ensure_best_policy(&config, &run).unwrap();
        assert!(run.best_policy().exists());
    }

    #[test]
    fn nothing_is_written_into_a_run_that_took_the_place_of_this_one_meanwhile() {
        let parent = tempfile::tempdir().unwrap();
        let path = parent.path().join("run");
        let (config, run) = run_with_last_policy(&path);
        let replace = |_, finished| {
            if finished == 2 {
                std::fs::rename(&path, parent.path().join("kept")).unwrap();
                run_with_last_policy(&path);
            }
        };
        let error = evaluate_and_keep_best(&config, &run, 1, &Interrupt::default(), replace).unwrap_err();
        assert!(error.to_string().contains("removed or renamed"), "{error}");
        assert!(!run.best_policy().exists() && !run.final_evaluation().exists());
    }

    #[test]
    fn the_last_policy_is_kept_only_if_it_is_better() {
        let candidate = |(policy, return_mean)| Candidate {
            policy,
            file: PolicyFile {
                fingerprint: 0,
                version: 1,
                env_steps: 1,
                return_mean: f64::NAN,
                return_std: 0.0,
                episodes: 0,
                parameters: Vec::new(),
            },
            summary: EvaluationSummary {
                return_mean,
                return_std: 0.0,
                episodes: 2,
                final_distance_mean: None,
                reached_fraction: None,
            },
        };
        let (best, last) = (SavedPolicy::Best, SavedPolicy::Last);
        for (returns, kept) in [
            (vec![(best, 1.0), (last, 1.0)], Some(best)),
            (vec![(best, 1.0), (last, 2.0)], Some(last)),
            (vec![(best, 2.0), (last, 1.0)], Some(best)),
            (vec![(best, f64::NAN), (last, -1.0)], Some(last)),
            (vec![(best, -1.0), (last, f64::INFINITY)], Some(best)),
            (vec![(last, 0.0)], Some(last)),
            (vec![(best, f64::NAN), (last, f64::NEG_INFINITY)], None),
            (vec![], None),
        ] {
            let candidates: Vec<Candidate> = returns.iter().copied().map(candidate).collect();
            assert_eq!(better(&candidates).map(|it| it.policy), kept, "{returns:?}");
        }
    }
}
