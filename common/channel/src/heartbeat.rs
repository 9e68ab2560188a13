//! A role's heartbeat.

use std::time::{Duration, Instant};

use shoal_base::report::{Activity, Heartbeat, Identity};

use super::domain::Domain;
use super::error::ChannelError;
use super::reports::Reporter;

const INTERVAL: Duration = Duration::from_millis(500);

/// Tells the launcher that this role lives, how far it is, and what it waits for. The first beat says that it is ready.
#[derive(Debug)]
pub struct HeartbeatSender {
    reporter: Reporter<Heartbeat>,
    heartbeat: Heartbeat,
    last: Option<Instant>,
}

impl HeartbeatSender {
    /// The pulse of a role that is not ready yet.
    ///
    /// # Errors
    /// When shared memory cannot be had.
    pub fn new(domain: &Domain, identity: Identity) -> Result<Self, ChannelError> {
        Ok(Self {
            reporter: Reporter::open(domain)?,
            heartbeat: Heartbeat::new(identity),
            last: None,
        })
    }

    /// Says that work begins which a process may not survive; at once, where none was ever done. So the launcher tells one
    /// that dies over its first step from one that was waiting.
    pub fn begin_work(&mut self) {
        if self.heartbeat.steps == 0 {
            self.beat_now(Activity::Working);
        }
    }

    /// Counts `steps` more steps of the role's work. The first are told at once: a process that gets as far as that is able
    /// to work.
    pub fn count(&mut self, steps: u64) {
        let first = self.heartbeat.steps == 0;
        self.heartbeat.steps += steps;
        if first {
            self.beat_now(Activity::Working);
        }
    }

    /// Counts an invalid answer of the environment server, and reports it at once.
    pub fn count_fault(&mut self) {
        self.heartbeat.faults = self.heartbeat.faults.saturating_add(1);
        self.beat_now(Activity::Working);
    }

    /// Says which policy the role uses.
    pub fn set_policy_version(&mut self, version: u64) {
        self.heartbeat.policy_version = version;
    }

    /// Beats if it is time to.
    pub fn beat(&mut self, activity: Activity) {
        if self.last.is_none_or(|last| last.elapsed() >= INTERVAL) {
            self.last = Some(Instant::now());
            self.heartbeat.set_activity(activity);
            self.reporter.look_after();
            self.reporter.send(self.heartbeat);
        }
    }

    /// Beats at once.
    pub fn beat_now(&mut self, activity: Activity) {
        self.last = None;
        self.beat(activity);
    }
}
