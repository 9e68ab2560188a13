//! What became of a run's processes on the way, apart from starting once and ending with the run.

use serde::{Deserialize, Serialize};
use shoal_common::report::Identity;

/// What happened to a role's process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum What {
    /// A signal ended it.
    #[default]
    Killed,
    /// It ended itself before its time.
    Failed,
    /// It made no progress, and was ended to be replaced.
    Stalled,
    /// An environment of it returned something invalid; its episodes were given up.
    Fault,
    /// It has a successor now.
    StartedAgain,
    /// It failed too often and gets no successor.
    GivenUp,
    /// It was one too many and has handed over what it had.
    Retired,
    /// The number of actors was changed.
    Scaled,
    /// A new launcher went on with the run.
    Resumed,
}

/// An incident, as it is handed to the recorder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Incident {
    /// The role's name.
    pub role: &'static str,
    /// Which one of that role.
    pub index: u32,
    /// What happened.
    pub what: What,
    /// More of it in words; may be empty.
    pub detail: String,
}

impl Incident {
    /// What became of this process.
    pub fn of(process: Identity, what: What, detail: String) -> Self {
        Self {
            role: process.role.name(),
            index: process.index,
            what,
            detail,
        }
    }

    /// An incident of the launcher's own.
    pub fn of_launcher(what: What, detail: String) -> Self {
        Self {
            role: "launcher",
            index: 0,
            what,
            detail,
        }
    }
}

/// A row of `incidents.csv`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct IncidentRow {
    /// Seconds the run had taken, over all its launchers.
    pub wall_seconds: f64,
    /// Environment steps the learner had last reported.
    pub env_steps: u64,
    /// The role's name.
    pub role: String,
    /// Which one of that role.
    pub index: u32,
    /// What happened.
    pub what: What,
    /// More of it in words; may be empty.
    pub detail: String,
}
