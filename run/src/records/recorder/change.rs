//! `changes.csv`: every change of a run's configuration after its start.

use std::path::Path;

use serde::{Deserialize, Serialize};
use shoal_common::run_dir::RunDir;

use super::table::{self, RecordError, Table};
use super::{LearnerRecord, read_learner};

/// A row of `changes.csv`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ChangeRecord {
    /// Running time of the run so far in seconds, over all its launchers.
    pub wall_seconds: f64,
    /// Environment steps of all actors so far.
    pub env_steps: u64,
    /// The key with its section.
    pub key: String,
    /// Its values, as `--set` takes them; empty where there is none.
    pub before: String,
    /// As `before`.
    pub after: String,
    /// Who changed it: an option of `resume`, `config.toml`, or `scale`.
    pub source: String,
}

/// A point in the life of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Moment {
    /// Running time of the run so far in seconds, over all its launchers.
    pub wall_seconds: f64,
    /// Environment steps of all actors so far.
    pub env_steps: u64,
}

impl Moment {
    /// Where the records of a run end that is not running.
    ///
    /// # Errors
    /// When they cannot be read.
    pub fn of_records(run: &RunDir) -> Result<Self, RecordError> {
        let learned: Vec<LearnerRecord> = read_learner(&run.learner_records())?;
        Ok(Self {
            wall_seconds: learned.last().map_or(0.0, |row| row.wall_seconds),
            env_steps: learned.iter().map(|row| row.env_steps).max().unwrap_or(0),
        })
    }
}

/// Creates the table with its header if there is none yet.
pub(super) fn create(run: &RunDir) -> Result<(), RecordError> {
    Table::open::<ChangeRecord>(&run.changes()).map(|_| ())
}

/// Appends these rows. They are in the file when this returns.
///
/// # Errors
/// When the table cannot be written.
pub fn record_changes(run: &RunDir, rows: &[ChangeRecord]) -> Result<(), RecordError> {
    let mut table = Table::open::<ChangeRecord>(&run.changes())?;
    rows.iter().try_for_each(|row| table.write(row))?;
    table.flush()
}

/// The rows of a `changes.csv`; empty if there is no such file, as in runs of earlier versions.
///
/// # Errors
/// When the table cannot be read.
pub fn read_changes(path: &Path) -> Result<Vec<ChangeRecord>, RecordError> {
    table::rows(path)
}
