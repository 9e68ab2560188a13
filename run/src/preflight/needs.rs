//! What a run needs of the machine, from its configuration alone: upper bounds over everything it may be scaled to.

use shoal_common::channel::{Listener, control, environment, policy, reports, transitions};
use shoal_common::config::Config;
use shoal_common::report::{EpisodeReport, EvaluatedReport, EvaluationReport, Heartbeat, LearnerReport};
use shoal_common::run_dir::RunDir;
use shoal_learner::process::{self, SizeError};

/// Log, records, figures and configuration of a run of usual length. They grow with the run, and a disk that fills up with
/// them is an error and no SIGBUS.
const RECORDS: u64 = 4 << 20;

/// What a policy's file has besides its parameters, and the block it may begin.
const POLICY_HEADER: u64 = 4 << 10;

/// Files that any process has open, and what the launcher or the learner adds for each actor. The learner was seen to have
/// 70 and 19, the launcher 70 and 18: a service that is held takes two, and a port or a connection one.
const FILES: u64 = 100;
const FILES_OF_AN_ACTOR: u64 = 22;

/// Bytes of shared memory that the run's files may come to have, with as many actors as it may be scaled to.
pub(super) fn shared_memory(config: &Config) -> u64 {
    let max = config.actors.max as usize;
    let (spec, actors) = (&config.spec, max as u64);
    let parameters = parameters(config);
    let explorer = environment::reserved(spec, config.actors.envs as usize)
        + transitions::reserved(&config.chunk_layout(), config.actors.window);
    // An environment server and whom it serves, for each actor and the evaluator; and the learner.
    let roles = 2 * (max + 1) + 1;
    actors * explorer
        + environment::reserved(spec, config.evaluation_envs() as usize)
        + control::reserved(max)
        + policy::reserved(max, parameters)
        + reports::reserved::<Heartbeat>(max, roles)
        + reports::reserved::<EpisodeReport>(max, max)
        + reports::reserved::<EvaluationReport>(max, 1)
        + reports::reserved::<EvaluatedReport>(max, 1)
        + reports::reserved::<LearnerReport>(max, 1)
        // One for each role, and the launcher's.
        + (roles as u64 + 1) * Listener::reserved(max)
}

/// Bytes of disk that the run's directory may come to need beyond what is in it.
///
/// # Errors
/// Where that is more than there can be.
pub(super) fn disk(config: &Config, run: &RunDir) -> Result<u64, SizeError> {
    let learner = process::disk_bytes(config, run)?;
    let policies = if config.evaluation.keep_policies {
        config.run.steps / config.evaluation.every + 1
    } else {
        0
    };
    let kept = policies.checked_mul((size_of::<f32>() * parameters(config)) as u64 + POLICY_HEADER);
    let sum = kept.and_then(|kept| learner.checked_add(kept)?.checked_add(RECORDS));
    sum.ok_or(SizeError::Sum {
        capacity: config.replay.capacity,
    })
}

/// Parameters of the policy. Who cannot control the environment is refused elsewhere.
fn parameters(config: &Config) -> usize {
    config
        .algorithm
        .policy_layout(&config.spec)
        .map_or(0, |layout| layout.parameters())
}

/// Files that the hungriest process of the run may have open.
pub(super) fn open_files(config: &Config) -> u64 {
    FILES + FILES_OF_AN_ACTOR * u64::from(config.actors.max)
}
