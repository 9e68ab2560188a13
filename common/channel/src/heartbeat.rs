//! A role's heartbeat.

use std::time::{Duration, Instant};

use shoal_base::report::{Heartbeat, PROVEN_STEPS};
use shoal_base::role::{Activity, RoleInstance};

use super::domain::Domain;
use super::error::ChannelError;
use super::reports::Reporter;

const INTERVAL: Duration = Duration::from_millis(500);

/// Reports to the launcher that this role is alive, how far it is, and what it waits for. The first heartbeat reports
/// that it is ready.
#[derive(Debug)]
pub struct HeartbeatSender {
    reporter: Reporter<Heartbeat>,
    heartbeat: Heartbeat,
    last_sent_at: Option<Instant>,
}

impl HeartbeatSender {
    /// Opens the channel. Nothing is sent yet.
    ///
    /// # Errors
    /// When shared memory is unavailable.
    pub fn new(domain: &Domain, instance: RoleInstance) -> Result<Self, ChannelError> {
        Ok(Self {
            reporter: Reporter::open(domain)?,
            heartbeat: Heartbeat::new(instance),
            last_sent_at: None,
        })
    }

    /// Reports at once that the first step begins. If the process dies in that step, the launcher knows that it was
    /// working and not waiting. Once a step is counted, this does nothing.
    pub fn announce_first_step(&mut self) {
        if self.heartbeat.steps == 0 {
            self.beat_now(Activity::Working);
        }
    }

    /// Counts `steps` more steps of the role's work. The first count is sent at once, and so is the one that reaches
    /// [`PROVEN_STEPS`]: the process may fail before its next heartbeat is due.
    pub fn count(&mut self, steps: u64) {
        let before = self.heartbeat.steps;
        self.heartbeat.steps += steps;
        let is_proven = (before..self.heartbeat.steps).contains(&(PROVEN_STEPS - 1));
        if before == 0 || is_proven {
            self.beat_now(Activity::Working);
        }
    }

    /// Counts an invalid answer of the environment server, and reports it at once.
    pub fn count_fault(&mut self) {
        self.heartbeat.faults = self.heartbeat.faults.saturating_add(1);
        self.beat_now(Activity::Working);
    }

    /// Sets the version of the policy that the role uses.
    pub fn set_policy_version(&mut self, version: u64) {
        self.heartbeat.policy_version = version;
    }

    /// Sends a heartbeat if one is due.
    pub fn beat(&mut self, activity: Activity) {
        if self.last_sent_at.is_none_or(|last| last.elapsed() >= INTERVAL) {
            self.last_sent_at = Some(Instant::now());
            self.heartbeat.set_activity(activity);
            self.reporter.refresh_connections();
            self.reporter.send(self.heartbeat);
        }
    }

    /// Sends a heartbeat at once.
    pub fn beat_now(&mut self, activity: Activity) {
        self.last_sent_at = None;
        self.beat(activity);
    }
}
