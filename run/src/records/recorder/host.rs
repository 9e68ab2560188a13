//! Records of other hosts: how fast, how far behind and how reliable each was.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use shoal_common::channel::control::{HostState, HostStatus};

use super::table::{self, RecordError, Table};

/// How often a host whose state does not change is recorded.
const INTERVAL: Duration = Duration::from_secs(5);

/// The state of a host in its record.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RecordedHostState {
    /// It sends reports.
    #[default]
    Connected,
    /// It has sent none for seconds.
    CutOff,
    /// It has left the run, or was silent for so long that its actors were freed.
    Gone,
}

/// A row of `hosts.csv`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct HostRecord {
    /// Running time of the run so far in seconds, over all its launchers.
    pub wall_seconds: f64,
    /// Environment steps by the learner's last report.
    pub env_steps: u64,
    /// Its number, in hexadecimal.
    pub host: String,
    /// Its name.
    pub name: String,
    /// Its state.
    pub state: RecordedHostState,
    /// The number of its actors.
    pub actors: u32,
    /// Rows a second that arrive from it.
    pub rows_per_second: f64,
    /// Chunks that it had to send more than once.
    pub resent_chunks: u64,
    /// Time from a report of the host to the answer, in microseconds.
    pub round_trip_us: Option<u64>,
    /// How many versions its newest policy is behind the learner's.
    pub policy_lag: u64,
}

/// Writes `hosts.csv`, which exists only if hosts have joined.
#[derive(Debug)]
pub(super) struct HostTable {
    path: PathBuf,
    table: Option<Table>,
    /// The last row of each host that is not gone, with the time of its writing.
    last: HashMap<u64, (Duration, HostRecord)>,
}

impl HostTable {
    pub(super) fn new(path: PathBuf) -> Self {
        Self {
            path,
            table: None,
            last: HashMap::new(),
        }
    }

    /// Records these hosts `wall` after the launcher's start: new ones, those whose state has changed, and the others
    /// every few seconds. A host that is missing here is gone. `moment` has the time and steps of the rows.
    pub(super) fn record(
        &mut self,
        hosts: &[HostStatus],
        wall: Duration,
        moment: super::Moment,
    ) -> Result<(), RecordError> {
        let mut rows = Vec::new();
        for status in hosts {
            let state = match status.state {
                HostState::Connected => RecordedHostState::Connected,
                HostState::CutOff => RecordedHostState::CutOff,
                HostState::Left => RecordedHostState::Gone,
            };
            let due = match self.last.get(&status.host) {
                None => state != RecordedHostState::Gone,
                Some((then, last)) => last.state != state || wall.saturating_sub(*then) >= INTERVAL,
            };
            if due {
                let row = HostRecord {
                    wall_seconds: moment.wall_seconds,
                    env_steps: moment.env_steps,
                    host: format!("{:016x}", status.host),
                    name: status.name.clone(),
                    state,
                    actors: status.actors,
                    rows_per_second: status.rows_per_second,
                    resent_chunks: status.resent_chunks,
                    round_trip_us: status.round_trip_us,
                    policy_lag: status.policy_lag,
                };
                rows.push((status.host, row));
            }
        }
        for (host, (_, last)) in &self.last {
            if !hosts.iter().any(|status| status.host == *host) {
                let row = HostRecord {
                    wall_seconds: moment.wall_seconds,
                    env_steps: moment.env_steps,
                    state: RecordedHostState::Gone,
                    rows_per_second: 0.0,
                    ..last.clone()
                };
                rows.push((*host, row));
            }
        }
        if rows.is_empty() {
            return Ok(());
        }
        let table = match &mut self.table {
            Some(table) => table,
            None => self.table.insert(Table::open::<HostRecord>(&self.path)?),
        };
        for (host, row) in rows {
            table.write(&row)?;
            if row.state == RecordedHostState::Gone {
                self.last.remove(&host);
            } else {
                self.last.insert(host, (wall, row));
            }
        }
        table.flush()
    }
}

/// The rows of a `hosts.csv`; empty if there is no such file: no host has joined the run.
pub fn read_hosts(path: &Path) -> Result<Vec<HostRecord>, RecordError> {
    table::rows(path)
}

#[cfg(test)]
mod tests {
    use super::super::Moment;
    use super::*;

    #[test]
    fn a_host_is_recorded_when_it_joins_changes_and_goes_and_in_between_every_few_seconds() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("hosts.csv");
        let mut table = HostTable::new(path.clone());
        let host = |host, state| HostStatus {
            host,
            name: format!("node-{host}"),
            state,
            actors: 4,
            wanted_actors: 4,
            rows_per_second: 1500.0,
            resent_chunks: 2,
            round_trip_us: Some(900),
            policy_lag: 1,
            silent_seconds: 0.0,
            roles: Vec::new(),
        };
        let mut at = |seconds: u64, hosts: &[HostStatus]| {
            let moment = Moment {
                wall_seconds: seconds as f64,
                env_steps: 10 * seconds,
            };
            table.record(hosts, Duration::from_secs(seconds), moment).unwrap();
        };
        at(0, &[]);
        assert!(!path.exists(), "no host has joined");
        at(1, &[host(1, HostState::Connected)]);
        at(2, &[host(1, HostState::Connected)]);
        at(6, &[host(1, HostState::Connected), host(2, HostState::Connected)]);
        at(7, &[host(1, HostState::CutOff), host(2, HostState::Connected)]);
        at(8, &[host(2, HostState::Left)]);
        at(9, &[]);
        at(10, &[host(1, HostState::Connected)]);
        let seen: Vec<_> = read_hosts(&path)
            .unwrap()
            .into_iter()
            .map(|row| (row.wall_seconds as u64, row.name, row.state))
            .collect();
        let row = |seconds, host, state| (seconds, format!("node-{host}"), state);
        use RecordedHostState::{Connected, CutOff, Gone};
        let expected = [
            row(1, 1, Connected),
            row(6, 1, Connected),
            row(6, 2, Connected),
            row(7, 1, CutOff),
            row(8, 2, Gone),
            row(8, 1, Gone),
            row(10, 1, Connected),
        ];
        assert_eq!(seen, expected);
    }
}
