//! How a run ended: `outcome.json` in its directory, written atomically by its launcher.

use serde::{Deserialize, Serialize};
use shoal_common::run_dir::RunDir;
use shoal_common::versioned_file::VersionedFile;

/// The reason in the outcome of a run whose launcher answers no requests yet. Its state is `Running`.
pub const STARTING: &str = "starting";

/// The reason in the outcome of a run that evaluates its policies once more. Its state is still `Running`.
pub const FINAL_EVALUATION: &str = "final evaluation";

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunOutcome {
    /// The run's state.
    pub state: RunState,
    /// Why it ended, if it did not finish.
    pub reason: Option<String>,
    /// Environment steps that were learned from.
    pub steps: u64,
    /// Episodes that were learned from.
    pub episodes: u64,
}

/// The state of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunState {
    /// A launcher is at work on it, or was killed.
    Running,
    /// All steps, updates and evaluations are done.
    Finished,
    /// It ended on request, and can be resumed.
    Stopped,
    /// It ended with an error.
    Failed,
}

impl VersionedFile for RunOutcome {
    const FORMAT: u32 = 1;
    const IF_DAMAGED: &'static str = "; remove it and the run can be resumed";
}

impl RunOutcome {
    /// An outcome without a reason.
    pub fn new(state: RunState, steps: u64, episodes: u64) -> Self {
        Self {
            state,
            reason: None,
            steps,
            episodes,
        }
    }

    /// The same outcome with this reason.
    pub fn with_reason(self, reason: impl Into<String>) -> Self {
        Self {
            reason: Some(reason.into()),
            ..self
        }
    }

    /// Reads the outcome; `None` if there is none, as in runs of earlier versions.
    ///
    /// # Errors
    /// When the file cannot be read, is damaged or has another format.
    pub fn read(run: &RunDir) -> anyhow::Result<Option<Self>> {
        Ok(Self::load_if_any(&run.outcome())?)
    }

    /// Writes the outcome atomically.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, run: &RunDir) -> anyhow::Result<()> {
        Ok(self.store(&run.outcome())?)
    }
}
