//! The roles of a run's processes, and what a role is doing.

use serde::{Deserialize, Serialize};

/// What a process of a run is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[repr(u32)]
pub enum Role {
    /// Steps environments.
    EnvServer,
    /// Explores.
    Actor,
    /// Evaluates the policy.
    Evaluator,
    /// Learns.
    Learner,
    /// Stands in for the actors of other hosts on the learner's host.
    Gate,
    /// Stands in for the learner on another host.
    Relay,
}

impl Role {
    /// The role's name on the command line, in the log and in service names.
    pub fn name(self) -> &'static str {
        match self {
            Self::EnvServer => "env-server",
            Self::Actor => "actor",
            Self::Evaluator => "evaluator",
            Self::Learner => "learner",
            Self::Gate => "gate",
            Self::Relay => "relay",
        }
    }

    const ALL: [Self; 6] = [
        Self::EnvServer,
        Self::Actor,
        Self::Evaluator,
        Self::Learner,
        Self::Gate,
        Self::Relay,
    ];

    /// The role with this name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|role| role.name() == name)
    }

    /// The role with this number in a message.
    pub(crate) fn from_code(code: u32) -> Option<Self> {
        Self::ALL.into_iter().find(|role| *role as u32 == code)
    }
}

/// Identifies a process of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RoleInstance {
    /// Its role.
    pub role: Role,
    /// Its index among the processes of that role.
    pub index: u32,
    /// The number of this process among all that the run has started, of whatever role. It is never used twice.
    pub incarnation: u64,
}

/// What a role is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[repr(u32)]
pub enum Activity {
    /// Doing its work.
    Working,
    /// Waiting for another role to appear or to send: an actor for its policy, a learner for rows, an environment
    /// server for a request.
    WaitingForPeer,
    /// An actor whose window is full, or a learner ahead of the ratio.
    WaitingForRatio,
    /// Finished with all its work.
    Done,
    /// Waiting for its environment server's answer.
    WaitingForServer,
}

impl Activity {
    /// The activity with this number in a message.
    pub(crate) fn from_code(code: u32) -> Option<Self> {
        let all = [
            Self::Working,
            Self::WaitingForPeer,
            Self::WaitingForRatio,
            Self::Done,
            Self::WaitingForServer,
        ];
        all.into_iter().find(|activity| *activity as u32 == code)
    }
}
