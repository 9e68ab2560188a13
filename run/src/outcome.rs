//! How a run ended: `outcome.json` in its directory, written by its launcher, whole or not at all.

use std::io::{self, ErrorKind, Write};

use anyhow::Context;
use serde::{Deserialize, Serialize};
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::RunDir;

/// The number of the file's form.
const FORMAT: u32 = 1;

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunOutcome {
    format: u32,
    /// What became of it.
    pub state: RunState,
    /// Why, where it did not finish.
    pub reason: Option<String>,
    /// Environment steps that were learned from.
    pub steps: u64,
    /// Episodes that were learned from.
    pub episodes: u64,
}

/// What became of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunState {
    /// A launcher works on it, or was killed over it.
    Running,
    /// All that was asked for is done: steps, updates, evaluations.
    Finished,
    /// It was asked to end, and can go on.
    Stopped,
    /// It ended for an error.
    Failed,
}

impl RunOutcome {
    /// An outcome without a reason.
    pub fn new(state: RunState, steps: u64, episodes: u64) -> Self {
        Self {
            format: FORMAT,
            state,
            reason: None,
            steps,
            episodes,
        }
    }

    /// The same outcome for this reason.
    pub fn because(self, reason: impl Into<String>) -> Self {
        Self {
            reason: Some(reason.into()),
            ..self
        }
    }

    /// What is written of the run; `None` where nothing is, as in runs of builds before this file.
    ///
    /// # Errors
    /// When the file cannot be read, or is damaged or of another form.
    pub fn read(run: &RunDir) -> anyhow::Result<Option<Self>> {
        let path = run.outcome();
        let text = match std::fs::read(&path) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            text => text.with_context(|| format!("cannot read {}", path.display()))?,
        };
        let outcome: Self = serde_json::from_slice(&text)
            .with_context(|| format!("{} is damaged; without it the run can be resumed", path.display()))?;
        if outcome.format != FORMAT {
            anyhow::bail!(
                "{} is of form {}, this program's is {FORMAT}",
                path.display(),
                outcome.format
            );
        }
        Ok(Some(outcome))
    }

    /// Writes it, whole or not at all.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, run: &RunDir) -> anyhow::Result<()> {
        let path = run.outcome();
        let text = serde_json::to_string(self)?;
        let write = |file: &mut dyn Write| -> io::Result<()> { writeln!(file, "{text}") };
        write_atomically(&path, |file| write(file)).with_context(|| format!("cannot write {}", path.display()))
    }
}
