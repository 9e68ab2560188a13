//! `shoal.log`: the output of all processes of the run. Only the launcher writes it.

use std::collections::{HashMap, VecDeque};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use anyhow::Context;
use shoal_common::run_dir::RunDir;

/// Number of lines kept per process, for the message when it is given up.
const KEPT: usize = 5;

/// The launcher's line after all roles have ended.
pub(crate) const ALL_ENDED: &str = "every role has ended";

/// The start of the launcher's last line if the run ended with an error.
pub(crate) const FAILED: &str = "the run failed: ";

/// Writes a line of the launcher into the log of a run whose roles have ended. A log that cannot be written is no error.
pub(crate) fn note(run: &RunDir, line: &str) {
    if let Ok(log) = Log::open(&run.log()) {
        log.note("launcher", line);
    }
}

/// The log of a run; clones write to the same file.
#[derive(Clone, Debug)]
pub(super) struct Log(Arc<Mutex<Inner>>);

#[derive(Debug)]
struct Inner {
    file: File,
    last: HashMap<String, VecDeque<String>>,
}

impl Log {
    pub(super) fn open(path: &Path) -> anyhow::Result<Self> {
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .mode(0o600)
            .open(path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        Ok(Self(Arc::new(Mutex::new(Inner {
            file,
            last: HashMap::new(),
        }))))
    }

    /// Writes a line of the launcher about `who`, with the time.
    pub(super) fn note(&self, who: &str, line: &str) {
        let seconds = SystemTime::UNIX_EPOCH
            .elapsed()
            .map_or(0.0, |since| since.as_secs_f64());
        self.write(who, &format!("{seconds:.3} {line}"));
    }

    /// Writes a line of output of `who`, which has its own time.
    pub(super) fn line(&self, who: &str, line: &str) {
        self.write(who, line);
        let mut inner = self.lock();
        let last = inner.last.entry(who.into()).or_default();
        if last.len() == KEPT {
            last.pop_front();
        }
        last.push_back(line.into());
    }

    /// The last lines that `who` wrote.
    pub(super) fn last_lines(&self, who: &str) -> Vec<String> {
        self.lock()
            .last
            .get(who)
            .map(|lines| lines.iter().cloned().collect())
            .unwrap_or_default()
    }

    fn write(&self, who: &str, line: &str) {
        // A log that cannot be written must not end the run.
        let _ = writeln!(self.lock().file, "{who:<14} {line}");
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
