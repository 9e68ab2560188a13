//! The joined hosts of a run, each in a line of the page.

use serde::Serialize;
use shoal_run::records::recorder::{HostRecord, RecordedHostState};

use super::numbers::short;
use crate::figure::quantile;

/// How a host of the run did, by its records.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct JoinedHost {
    name: String,
    actors: u32,
    /// When it was first recorded, in s.
    joined: f64,
    /// When it went, in s; `None` if it was there to the end.
    gone: Option<f64>,
    /// Median over the records while it was connected; `None` if there are none.
    rows_per_second: Option<f64>,
    /// Median, in ms.
    round_trip: Option<f64>,
    /// Median of the versions that its policy was behind.
    policy_lag: Option<f64>,
    resent_chunks: u64,
    /// How often it was cut off.
    cut_offs: usize,
}

impl JoinedHost {
    /// The hosts of these records, in the order in which they joined.
    pub(super) fn all(records: &[HostRecord]) -> Vec<Self> {
        let mut hosts: Vec<Vec<&HostRecord>> = Vec::new();
        for record in records {
            match hosts.iter_mut().find(|rows| rows[0].host == record.host) {
                Some(rows) => rows.push(record),
                None => hosts.push(vec![record]),
            }
        }
        hosts.iter().map(|rows| Self::of(rows)).collect()
    }

    /// `rows` are all of one host and at least one.
    fn of(rows: &[&HostRecord]) -> Self {
        let (first, last) = (rows[0], rows[rows.len() - 1]);
        let connected = || rows.iter().filter(|row| row.state == RecordedHostState::Connected);
        // A host whose state does not change is recorded every few seconds too.
        let is_cut = |row: &HostRecord| row.state == RecordedHostState::CutOff;
        let cut_offs = (0..rows.len()).filter(|i| is_cut(rows[*i]) && (*i == 0 || !is_cut(rows[*i - 1])));
        // The first record of a host has no rate yet.
        let rates = connected().skip(1).map(|row| row.rows_per_second);
        Self {
            name: last.name.clone(),
            actors: last.actors,
            joined: short(first.wall_seconds),
            gone: (last.state == RecordedHostState::Gone).then(|| short(last.wall_seconds)),
            rows_per_second: median(rates),
            round_trip: median(connected().filter_map(|row| Some(row.round_trip_us? as f64 / 1e3))),
            policy_lag: median(connected().map(|row| row.policy_lag as f64)),
            resent_chunks: rows.iter().map(|row| row.resent_chunks).max().unwrap_or(0),
            cut_offs: cut_offs.count(),
        }
    }
}

/// `None` if there are no values.
fn median(values: impl Iterator<Item = f64>) -> Option<f64> {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    (!values.is_empty()).then(|| short(quantile(&values, 0.5)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_is_summed_up_by_its_records() {
        use RecordedHostState::{Connected, CutOff, Gone};
        let record = |wall_seconds, host: &str, state, rows_per_second, resent_chunks| HostRecord {
            wall_seconds,
            host: host.into(),
            name: format!("node-{host}"),
            state,
            actors: 2,
            rows_per_second,
            resent_chunks,
            round_trip_us: Some(500),
            ..HostRecord::default()
        };
        let records = [
            record(1.0, "a", Connected, 0.0, 0),
            record(2.0, "b", Connected, 0.0, 0),
            record(6.0, "a", Connected, 100.0, 3),
            record(7.0, "a", CutOff, 0.0, 3),
            record(8.5, "a", CutOff, 0.0, 3),
            record(8.0, "b", Gone, 0.0, 0),
            record(9.0, "a", Connected, 300.0, 7),
            record(14.0, "a", Connected, 200.0, 7),
        ];
        let [a, b] = JoinedHost::all(&records).try_into().unwrap();
        assert_eq!(
            (a.name.as_str(), a.joined, a.gone, a.cut_offs),
            ("node-a", 1.0, None, 1)
        );
        assert_eq!(
            (a.rows_per_second, a.round_trip, a.resent_chunks),
            (Some(200.0), Some(0.5), 7)
        );
        assert_eq!((b.gone, b.rows_per_second, b.cut_offs), (Some(8.0), None, 0));
        assert_eq!(JoinedHost::all(&[]), []);
    }
}
