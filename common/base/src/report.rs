//! What the roles report to the launcher while they work: small plain structs, a channel for each kind.
//!
//! An *update* is a gradient step or, for algorithms that use each row once, a consumed row.

use iceoryx2::prelude::ZeroCopySend;
use serde::{Deserialize, Serialize};

use crate::role::{Activity, Role, RoleInstance};

/// After this many steps an environment server counts as able to work: it is then restarted whenever it fails.
pub const PROVEN_STEPS: u64 = 1000;

/// A sign of life of a role: sent when it is ready, when a lasting activity begins, and about twice a second.
///
/// Role and activity are sent as numbers, because a sender in another language may know more of them than this build.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ZeroCopySend)]
#[type_name("ShoalHeartbeat")]
#[repr(C)]
pub struct Heartbeat {
    role: u32,
    /// Its index among the processes of that role.
    pub index: u32,
    activity: u32,
    /// For an actor or the evaluator: invalid answers of its environment server since it started.
    pub faults: u32,
    /// Its incarnation.
    pub incarnation: u64,
    /// Environment steps since it started; for a learner updates.
    pub steps: u64,
    /// Version of the policy it uses or publishes.
    pub policy_version: u64,
}

impl Heartbeat {
    /// The heartbeat of a role that has done nothing yet.
    pub fn new(instance: RoleInstance) -> Self {
        let RoleInstance {
            role,
            index,
            incarnation,
        } = instance;
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

    /// The role; `None` if this build does not know it.
    pub fn role(&self) -> Option<Role> {
        Role::from_code(self.role)
    }

    /// What the role is doing; `None` for an activity that this build does not know.
    pub fn activity(&self) -> Option<Activity> {
        Activity::from_code(self.activity)
    }

    /// Sets what the role is doing.
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
    /// Index of the environment within the actor.
    pub environment: u32,
    /// Steps it took.
    pub steps: u32,
    /// 1 if the environment terminated, 0 if the time limit truncated the episode.
    pub terminated: u32,
    /// Sum of its rewards, undiscounted.
    pub episode_return: f64,
    /// Version of the policy at its end.
    pub policy_version: u64,
    /// Environment steps in the replay when it ended.
    pub env_steps: u64,
}

/// A policy has been evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, ZeroCopySend)]
#[repr(C)]
pub struct EvaluationReport {
    /// Version of the evaluated policy.
    pub policy_version: u64,
    /// Environment steps that the policy was learned from.
    pub env_steps: u64,
    /// Updates that made the policy.
    pub updates: u64,
    /// Mean of the episodes' returns.
    pub return_mean: f64,
    /// Standard deviation of the episodes' returns (of the sample: n − 1).
    pub return_std: f64,
    /// Episodes run.
    pub episodes: u32,
    /// 1 if this policy became the best one.
    pub best: u32,
}

/// The progress of the evaluator: sent when it starts and after each policy that it has evaluated.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ZeroCopySend)]
#[repr(C)]
pub struct EvaluatedPeriod {
    /// The period of the last evaluated policy.
    pub period: u64,
}

/// The progress of the learner: sent about twice a second.
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend)]
#[repr(C)]
pub struct LearnerReport {
    /// Environment steps committed to the replay.
    pub env_steps: u64,
    /// Episodes that end within them.
    pub episodes: u64,
    /// Updates so far.
    pub updates: u64,
    /// Version of the policy published last.
    pub policy_version: u64,
    /// Mean squared error of the value estimates (the critic, line 13 of Algorithm 4; the baseline; or the table),
    /// averaged over the updates since the last report.
    pub critic_loss: f64,
    /// The loss of the policy, averaged as `critic_loss`: −mean Q(s, μ(s)), or for REINFORCE the negative of its
    /// objective.
    pub actor_loss: f64,
    /// Mean Q(s, a), or for REINFORCE the mean return, averaged as `critic_loss`.
    pub q_mean: f64,
    /// The temperature α, averaged as `critic_loss`; NaN for algorithms without one.
    pub temperature: f64,
    /// Number of updates in the averages; if it is 0, they are 0.
    pub averaged: u64,
}
