//! `shoal.log`: what every process of the run had to say, written by the launcher alone.

use std::collections::{HashMap, VecDeque};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;

use anyhow::Context;

/// Lines of each process that are kept for the message when it is given up.
const KEPT: usize = 5;

/// What the launcher writes when it ends in order.
pub(crate) const EVERYBODY_ENDED: &str = "every role has ended";

/// What a launcher's line begins with that ends for an error.
pub(crate) const FAILED: &str = "the run failed: ";

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

    /// A line of the launcher's own, about `who`.
    pub(super) fn note(&self, who: &str, line: &str) {
        let seconds = SystemTime::UNIX_EPOCH
            .elapsed()
            .map_or(0.0, |since| since.as_secs_f64());
        self.write(who, &format!("{seconds:.3} {line}"));
    }

    /// A line that `who` wrote, which brings its own time.
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
        // A log that cannot be written must not end the run it is about.
        let _ = writeln!(self.lock().file, "{who:<14} {line}");
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
