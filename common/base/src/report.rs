//! What the roles tell the launcher while they work: small plain structs, one kind a channel.

use iceoryx2::prelude::ZeroCopySend;
use serde::{Deserialize, Serialize};

/// A process of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
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
}

impl Role {
    /// The role's name on the command line, in the log and in service names.
    pub fn name(self) -> &'static str {
        match self {
            Self::EnvServer => "env-server",
            Self::Actor => "actor",
            Self::Evaluator => "evaluator",
            Self::Learner => "learner",
        }
    }

    /// Reads the number a role travels as.
    fn from_code(code: u32) -> Option<Self> {
        [Self::EnvServer, Self::Actor, Self::Evaluator, Self::Learner]
            .into_iter()
            .find(|role| *role as u32 == code)
    }
}

impl Activity {
    /// Reads the number an activity travels as.
    fn from_code(code: u32) -> Option<Self> {
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

/// A process of a run: which role, which one of it, and which start of that one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Identity {
    /// What it is for.
    pub role: Role,
    /// Which one of that role.
    pub index: u32,
    /// Grows with every process that the run starts, whatever its role.
    pub incarnation: u64,
}

/// What a role is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum Activity {
    /// Doing its work.
    Working,
    /// Waiting for another role to appear or to send: an actor for its policy, a learner for rows, an environment server
    /// for a request.
    WaitingForPeer,
    /// An actor whose window is full, or a learner ahead of the ratio.
    WaitingForRatio,
    /// Through with everything.
    Done,
    /// Waiting for its environment server's answer.
    WaitingForServer,
}

/// A role lives: sent when it is ready, whenever its activity changes for long, and about twice a second.
///
/// Role and activity travel as numbers, because a sender in another language may know more of them than we do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ZeroCopySend)]
#[type_name("ShoalHeartbeat")]
#[repr(C)]
pub struct Heartbeat {
    role: u32,
    /// Which one of that role.
    pub index: u32,
    activity: u32,
    /// Of an actor or the evaluator: invalid answers of its environment server, since it started.
    pub faults: u32,
    /// Which start of it.
    pub incarnation: u64,
    /// Environment steps it has made, or updates of a learner, since it started.
    pub steps: u64,
    /// Version of the policy it uses or publishes.
    pub policy_version: u64,
}

impl Heartbeat {
    /// The heartbeat of a role that has done nothing yet.
    pub fn new(identity: Identity) -> Self {
        let Identity {
            role,
            index,
            incarnation,
        } = identity;
        let activity = Activity::WaitingForPeer as u32;
        Self {
            role: role as u32,
            index,
            activity,
            faults: 0,
            incarnation,
            steps: 0,
            policy_version: 0,
        }
    }

    /// Who; `None` for a role this build does not know.
    pub fn role(&self) -> Option<Role> {
        Role::from_code(self.role)
    }

    /// What it does; `None` for an activity this build does not know.
    pub fn activity(&self) -> Option<Activity> {
        Activity::from_code(self.activity)
    }

    /// Says what the role does now.
    pub fn set_activity(&mut self, activity: Activity) {
        self.activity = activity as u32;
    }
}

/// An exploration episode has ended.
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[repr(C)]
pub struct EpisodeReport {
    /// The actor that ran it.
    pub actor: u32,
    /// Which of the actor's environments.
    pub environment: u32,
    /// Steps it took.
    pub steps: u32,
    /// 1 where the environment terminated, 0 where the time limit truncated.
    pub terminated: u32,
    /// Sum of its rewards, undiscounted.
    pub episode_return: f64,
    /// Version of the policy at its end.
    pub policy_version: u64,
    /// Rows in the replay when it ended.
    pub env_steps: u64,
}

/// A policy has been evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ZeroCopySend)]
#[repr(C)]
pub struct EvaluationReport {
    /// The policy's version.
    pub policy_version: u64,
    /// Environment steps the policy was learned from.
    pub env_steps: u64,
    /// Updates the policy was made by.
    pub updates: u64,
    /// Mean of the episodes' returns.
    pub return_mean: f64,
    /// Their standard deviation (of the sample: n − 1).
    pub return_std: f64,
    /// Episodes run.
    pub episodes: u32,
    /// 1 where no earlier evaluation of the run was as good.
    pub best: u32,
}

/// How far the evaluating is: sent when an evaluator begins and after each policy it has evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
pub struct EvaluatedReport {
    /// The period of the policy evaluated last.
    pub period: u64,
}

/// How the learner gets on: sent about twice a second.
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[repr(C)]
pub struct LearnerReport {
    /// Environment steps committed to the replay.
    pub env_steps: u64,
    /// Episodes that end within them.
    pub episodes: u64,
    /// Updates done.
    pub updates: u64,
    /// Version of the policy published last.
    pub policy_version: u64,
    /// Mean squared error of what estimates values, averaged over the updates since the last report (line 13 of Algorithm
    /// 4; of the baseline; of the table).
    pub critic_loss: f64,
    /// What the policy's steps make smaller, averaged likewise: −mean Q(s, μ(s)); of REINFORCE, its objective's negative.
    pub actor_loss: f64,
    /// Mean Q(s, a), or of REINFORCE the mean return, averaged likewise.
    pub q_mean: f64,
    /// Updates averaged over; the three means are 0 where it is 0.
    pub averaged: u64,
}
