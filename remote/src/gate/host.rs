//! A host that is admitted, and its status.

use std::collections::HashMap;
use std::time::Instant;

use shoal_common::channel::control::{HostLease, HostState, HostStatus, RoleState, RoleStatus};
use shoal_common::role::{Activity, Role};
use zenoh::pubsub::Publisher;
use zenoh::query::Query;

use crate::network::CUT_OFF_AFTER;
use crate::wire::{ActorAcknowledgement, HostReport, PolicyId, ReportNumber};

/// A host that is admitted.
pub(super) struct Host {
    pub(super) lease: HostLease,
    pub(super) acknowledgements: Publisher<'static>,
    pub(super) last_acknowledged: Vec<ActorAcknowledgement>,
    pub(super) acknowledged_at: Instant,
    /// An acknowledgement is sent soon, whether anything has changed or not.
    pub(super) acknowledgement_due: bool,
    /// When it was last heard of, or admitted.
    pub(super) heard_at: Instant,
    /// Whether it has asked this gate to be admitted, or has reported to it. The launcher also names hosts that only an
    /// earlier gate knew.
    pub(super) has_contacted: bool,
    /// The number of its last report.
    pub(super) last_report: ReportNumber,
    pub(super) has_left: bool,
    pub(super) newest_report: Option<HostReport>,
    pub(super) warned_at: Option<Instant>,
    /// Rows that were forwarded to the learner.
    pub(super) forwarded_rows: u64,
    /// The time of the last status, and `forwarded_rows` at that time.
    pub(super) rows_at_last_status: (Instant, u64),
    pub(super) rows_per_second: f64,
    /// The steps of its processes at the last status.
    pub(super) steps_at_last_status: HashMap<(Role, u32), (u64, u64)>,
    /// Its query for a policy, the policy that it has, and when the query arrived.
    pub(super) policy_query: Option<(Query, Option<PolicyId>, Instant)>,
}

impl Host {
    /// Whether it may be the reason why a lockstep run makes no progress: it is cut off, or some of its actors and
    /// environment servers do not wait.
    pub(super) fn is_awaited(&self) -> bool {
        let roles = self.newest_report.iter().flat_map(|report| &report.roles);
        let waiting = roles.filter(|role| role.activity != Activity::Working).count();
        self.heard_at.elapsed() >= CUT_OFF_AFTER || waiting < 2 * self.lease.actors.len()
    }

    /// Its status, when the newest policy has this version. Rates are those since the last call.
    pub(super) fn status(&mut self, newest: u64) -> HostStatus {
        let (then, rows) = self.rows_at_last_status;
        let seconds = then.elapsed().as_secs_f64();
        if seconds > 0.0 {
            self.rows_per_second = (self.forwarded_rows - rows) as f64 / seconds;
        }
        self.rows_at_last_status = (Instant::now(), self.forwarded_rows);
        let silent = self.heard_at.elapsed();
        let cut_off = !self.has_contacted || silent >= CUT_OFF_AFTER;
        let mut roles = Vec::new();
        for role in self.newest_report.iter().flat_map(|report| &report.roles) {
            let key = (role.role, role.index);
            let before = self.steps_at_last_status.insert(key, (role.incarnation, role.steps));
            let taken = before
                .filter(|(incarnation, _)| *incarnation == role.incarnation)
                .map_or(0, |(_, steps)| role.steps.saturating_sub(steps));
            roles.push(RoleStatus {
                role: role.role,
                index: role.index,
                pid: None,
                state: if cut_off {
                    RoleState::Silent
                } else {
                    role.activity.into()
                },
                restarts: 0,
                rate: if seconds > 0.0 { taken as f64 / seconds } else { 0.0 },
                policy_version: (role.role == Role::Actor).then_some(role.policy_version),
                policy_lag: (role.role == Role::Actor).then(|| newest.saturating_sub(role.policy_version)),
            });
        }
        let report = self.newest_report.as_ref();
        HostStatus {
            host: self.lease.host,
            name: self.lease.name.clone(),
            state: match (self.has_left, cut_off) {
                (true, _) => HostState::Left,
                (false, true) => HostState::CutOff,
                (false, false) => HostState::Connected,
            },
            actors: self.lease.actors.len() as u32,
            wanted_actors: self.lease.wanted_actors,
            rows_per_second: self.rows_per_second,
            resent_chunks: report.map_or(0, |report| report.resent),
            round_trip_us: report.and_then(|report| report.round_trip_us),
            policy_lag: report.map_or(0, |report| newest.saturating_sub(report.policy_version)),
            silent_seconds: silent.as_secs_f64(),
            roles,
        }
    }
}
