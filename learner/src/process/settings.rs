//! A learner's settings.

use shoal_common::config::Config;
use shoal_common::role::RoleInstance;
use shoal_common::run_dir::RunDir;

/// The settings of a learner.
#[derive(Clone, Debug)]
pub struct LearnerSettings {
    /// Which process this is.
    pub instance: RoleInstance,
    /// The run's configuration.
    pub config: Config,
    /// The run's directory, where the replay, the checkpoints and the last policy are.
    pub run: RunDir,
    /// The period of the policy that was evaluated last.
    pub evaluated_period: Option<u64>,
}
