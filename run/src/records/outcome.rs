//! How a run ended: `outcome.json` in its directory, written atomically by the process that has the run's lock.

use std::fmt;

use serde::{Deserialize, Serialize};
use shoal_common::message::one_line;
use shoal_common::run_dir::RunDir;
use shoal_common::versioned_file::VersionedFile;

use crate::signals::describe;

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunOutcome {
    /// The run's state.
    pub state: RunState,
    /// Why a running run has no roles; why another one did not finish, or has no final evaluation.
    pub reason: Option<OutcomeReason>,
    /// Environment steps that were learned from.
    pub steps: u64,
    /// Episodes that were learned from.
    pub episodes: u64,
}

/// Why a run is in its state. The file has it as text.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "String", into = "String")]
pub enum OutcomeReason {
    /// The launcher of a running run has no roles yet and answers no requests.
    Starting,
    /// The launcher of a running run evaluates its policies once more, without roles.
    FinalEvaluation,
    /// This signal, in words, has ended the final evaluation of a finished run.
    EvaluationEnded(String),
    /// Any other reason, in words.
    Other(String),
}

impl OutcomeReason {
    const STARTING: &str = "starting";
    const FINAL_EVALUATION: &str = "final evaluation";
    const EVALUATION_ENDED: &str = "the final evaluation was ended by ";

    /// Why a finished run has no final evaluation: this signal has ended it, or otherwise this error.
    pub fn of_missing_evaluation(signal: Option<i32>, error: &anyhow::Error) -> Self {
        match signal {
            Some(signal) => Self::EvaluationEnded(describe(signal)),
            None => Self::Other(format!("the final evaluation failed: {}", one_line(error))),
        }
    }
}

impl fmt::Display for OutcomeReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Starting => f.write_str(Self::STARTING),
            Self::FinalEvaluation => f.write_str(Self::FINAL_EVALUATION),
            Self::EvaluationEnded(signal) => write!(f, "{}{signal}", Self::EVALUATION_ENDED),
            Self::Other(reason) => f.write_str(reason),
        }
    }
}

impl From<String> for OutcomeReason {
    fn from(reason: String) -> Self {
        match (reason.as_str(), reason.strip_prefix(Self::EVALUATION_ENDED)) {
            (Self::STARTING, _) => Self::Starting,
            (Self::FINAL_EVALUATION, _) => Self::FinalEvaluation,
            (_, Some(signal)) => Self::EvaluationEnded(signal.to_owned()),
            (_, None) => Self::Other(reason),
        }
    }
}

impl From<OutcomeReason> for String {
    fn from(reason: OutcomeReason) -> Self {
        reason.to_string()
    }
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
    pub fn with_reason(self, reason: impl Into<OutcomeReason>) -> Self {
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
