//! The resources a run needs, from its configuration alone: upper bounds for every number of actors it may be scaled
//! to.

use shoal_common::channel::{Listener, control, environment, policy, reports, transitions};
use shoal_common::config::Config;
use shoal_common::durable::allocated_bytes;
use shoal_common::report::{EpisodeReport, EvaluatedPeriod, EvaluationReport, Heartbeat, LearnerReport};
use shoal_common::run_dir::RunDir;
use shoal_learner::process::{self, SizeError};

/// Log, records, figures and configuration of a run of usual length. They grow with the run; a disk that they fill up
/// causes an error, not a SIGBUS.
const RECORDS: u64 = 4 << 20;

/// Bytes of a policy file besides its parameters, including the unused part of its last disk block.
const POLICY_HEADER: u64 = 4 << 10;

/// Files that a process has open without actors, and the files per actor in the launcher or the learner. A service
/// takes two, a port or a connection one. Measured: 70 and 19 in the learner, 70 and 18 in the launcher.
const FILES: u64 = 100;
const FILES_PER_ACTOR: u64 = 22;

/// Bytes of shared memory that the run may come to use with `actors.max` actors.
pub(super) fn shared_memory(config: &Config) -> u64 {
    let max = config.actors.max_on_a_host() as usize;
    let (spec, actors) = (&config.spec, max as u64);
    let parameters = parameters(config);
    let of_an_actor = environment::reserved(spec, config.actors.envs as usize)
        + transitions::reserved(&config.chunk_layout(), config.actors.window);
    // The actors and the evaluator, an environment server for each, the learner, and the gate if other hosts may join.
    let roles = 2 * (max + 1) + 2;
    actors * of_an_actor
        + environment::reserved(spec, config.evaluation_envs() as usize)
        + control::reserved(config.actors.max as usize)
        + shared_transitions(config)
        + policy::reserved(max, parameters)
        + reports::reserved::<Heartbeat>(max, roles)
        // The actors' and the gate's.
        + reports::reserved::<EpisodeReport>(max, max + 1)
        + reports::reserved::<EvaluationReport>(max, 1)
        + reports::reserved::<EvaluatedPeriod>(max, 1)
        + reports::reserved::<LearnerReport>(max, 1)
        // One for each process, and one for the launcher.
        + (roles as u64 + 1) * Listener::reserved(max)
}

/// Bytes of the service that actors of joined hosts share.
fn shared_transitions(config: &Config) -> u64 {
    match config.actors_that_share() {
        0 => 0,
        actors => transitions::reserved(&config.chunk_layout(), actors * config.actors.window),
    }
}

/// Bytes of disk that the run's directory may come to need beyond what it holds now.
///
/// # Errors
/// When the number does not fit into 64 bits.
pub(super) fn disk(config: &Config, run: &RunDir) -> Result<u64, SizeError> {
    let learner = process::disk_bytes(config, run)?;
    let policies = if config.evaluation.keep_policies {
        config.run.steps / config.evaluation.every + 1
    } else {
        0
    };
    let kept = policies
        .checked_mul((size_of::<f32>() * parameters(config)) as u64 + POLICY_HEADER)
        .map(|kept| kept.saturating_sub(kept_policies(run)));
    let sum = kept.and_then(|kept| learner.checked_add(kept)?.checked_add(RECORDS));
    sum.ok_or(SizeError::Sum {
        capacity: config.replay.capacity,
    })
}

/// Bytes of disk that the run's kept policies occupy; 0 if they cannot be listed.
fn kept_policies(run: &RunDir) -> u64 {
    let entries = std::fs::read_dir(run.policies()).into_iter().flatten().flatten();
    entries.map(|entry| allocated_bytes(&entry.path())).sum()
}

/// Parameters of the policy; 0 for an algorithm that cannot control the environment, which is refused elsewhere.
fn parameters(config: &Config) -> usize {
    config.policy_layout().map_or(0, |layout| layout.parameters())
}

/// Files that any one process of the run may have open.
pub(super) fn open_files(config: &Config) -> u64 {
    FILES + FILES_PER_ACTOR * u64::from(config.actors.max_on_a_host())
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use rustix::fs::{FallocateFlags, fallocate};

    use super::*;
    use crate::plan::resolve_preset;

    #[test]
    fn what_a_killed_start_has_reserved_for_the_replay_is_not_needed_again() {
        const RESERVED: u64 = 1 << 20;
        let config = resolve_preset("pendulum").unwrap();
        let directory = tempfile::tempdir().unwrap();
        let run = RunDir::at(directory.path());
        let before = disk(&config, &run).unwrap();
        let unfinished = File::create(directory.path().join("replay.bin.new")).unwrap();
        assert_eq!(disk(&config, &run).unwrap(), before, "nothing is reserved yet");
        fallocate(&unfinished, FallocateFlags::empty(), 0, RESERVED).unwrap();
        let needed = disk(&config, &run).unwrap();
        // A file system may need blocks of its own for the file.
        assert!(
            needed <= before - RESERVED && needed > before / 2,
            "{needed} of {before}"
        );
    }

    #[test]
    fn what_checkpoints_and_kept_policies_occupy_is_not_needed_again() {
        let mut config = resolve_preset("pendulum").unwrap();
        config.evaluation.keep_policies = true;
        let directory = tempfile::tempdir().unwrap();
        let run = RunDir::at(directory.path());
        std::fs::create_dir(run.checkpoints()).unwrap();
        std::fs::create_dir(run.policies()).unwrap();
        let mut needed = disk(&config, &run).unwrap();
        let checkpoints = ["latest.ckpt", "previous.ckpt", "latest.ckpt.new"].map(|name| run.checkpoints().join(name));
        let policies = [run.best_policy(), run.last_policy(), run.evaluated_policy(100)];
        for path in checkpoints.into_iter().chain(policies) {
            // As much as one disk block of most file systems.
            let file = File::create(&path).unwrap();
            fallocate(&file, FallocateFlags::empty(), 0, 4 << 10).unwrap();
            let rest = disk(&config, &run).unwrap();
            assert!(rest <= needed - (4 << 10), "{}: {rest} of {needed}", path.display());
            needed = rest;
        }
        // More than a run of this length needs.
        let other = File::create(run.evaluated_policy(200)).unwrap();
        fallocate(&other, FallocateFlags::empty(), 0, 1 << 30).unwrap();
        assert!(disk(&config, &run).unwrap() >= RECORDS);
    }
}
