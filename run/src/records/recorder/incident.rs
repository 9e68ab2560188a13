//! Incidents: what happens to a run's processes besides their first start and their end with the run.

use serde::{Deserialize, Serialize};
use shoal_common::role::RoleInstance;

/// The kind of an incident.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum IncidentKind {
    /// A signal ended the process.
    #[default]
    Killed,
    /// The process ended early by itself.
    Failed,
    /// The process made no progress and was killed to be replaced.
    Stalled,
    /// An environment of the process returned something invalid, and its episodes were given up.
    Fault,
    /// The role's process was restarted.
    #[serde(rename = "started-again")]
    Restarted,
    /// The role failed too often and is not started again.
    GivenUp,
    /// The actor was no longer needed and has handed over its transitions, or its environment server ended.
    Retired,
    /// The number of actors was changed.
    Scaled,
    /// A new launcher continued the run.
    Resumed,
}

/// An incident for the recorder.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Incident {
    /// The role's name.
    pub role: &'static str,
    /// The process's index within its role.
    pub index: u32,
    /// What happened.
    pub what: IncidentKind,
    /// Details in words; may be empty.
    pub detail: String,
}

impl Incident {
    /// An incident of this process.
    pub fn of(process: RoleInstance, what: IncidentKind, detail: String) -> Self {
        Self {
            role: process.role.name(),
            index: process.index,
            what,
            detail,
        }
    }

    /// An incident of the launcher itself.
    pub fn of_launcher(what: IncidentKind, detail: String) -> Self {
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
pub struct IncidentRecord {
    /// Running time of the run so far in seconds, over all its launchers.
    pub wall_seconds: f64,
    /// Environment steps by the learner's last report.
    pub env_steps: u64,
    /// The role's name.
    pub role: String,
    /// The process's index within its role.
    pub index: u32,
    /// What happened.
    pub what: IncidentKind,
    /// Details in words; may be empty.
    pub detail: String,
}
