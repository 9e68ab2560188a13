//! `shoal.log`: the output of all processes of the run, each line with its time in UTC. Only the launcher writes it.

use std::collections::{HashMap, VecDeque};
use std::fs::{File, OpenOptions};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use anyhow::Context;
use shoal_common::run_dir::RunDir;
use shoal_run::child_process::{Line, OutputSource};
use tracing_subscriber::fmt::format;
use tracing_subscriber::fmt::time::{FormatTime, SystemTime};

/// Last lines kept of each process: they are logged when it ends, and the last one is shown when it is given up.
const KEPT: usize = 5;

/// Size of the log, in bytes, above which lines of other programs are left out. Each launcher accepts at least the
/// second number of bytes from them. Shoal's own lines have no limit.
const MAX_LOG_BYTES: u64 = 16 * 1024 * 1024;
const MIN_PROGRAM_BYTES: u64 = 1024 * 1024;

/// The launcher's line after all roles have ended.
pub(crate) const ALL_ENDED: &str = "every role has ended";

/// The start of the launcher's last line if the run ended with an error.
pub(crate) const FAILED: &str = "the run failed: ";

/// Writes a line of the launcher into the log of a run whose roles have ended, if the log can be written.
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
    last: HashMap<String, VecDeque<KeptLine>>,
    /// Bytes that other programs may still write; `None` once the log has said that it takes no more.
    program_bytes_left: Option<u64>,
}

/// A line that a process has written.
#[derive(Debug)]
struct KeptLine {
    text: String,
    is_in_log: bool,
}

impl Log {
    pub(super) fn open(path: &Path) -> anyhow::Result<Self> {
        let file = OpenOptions::new()
            .create(true)
            .append(true)
            .mode(0o600)
            .open(path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        let length = file.metadata().map_or(0, |metadata| metadata.len());
        Ok(Self(Arc::new(Mutex::new(Inner {
            file,
            last: HashMap::new(),
            program_bytes_left: Some(MAX_LOG_BYTES.saturating_sub(length).max(MIN_PROGRAM_BYTES)),
        }))))
    }

    /// Writes a line of the launcher about `who`.
    pub(super) fn note(&self, who: &str, line: &str) {
        self.lock().write(who, line);
    }

    /// Writes a line of output of `who`, unless it exceeds a limit.
    pub(super) fn line(&self, who: &str, line: Line<'_>, source: OutputSource) {
        let mut inner = self.lock();
        match line {
            Line::Kept(text) => {
                let is_in_log = source == OutputSource::Shoal || inner.takes(text);
                if is_in_log {
                    inner.write(who, text);
                }
                inner.remember(who, text, is_in_log);
            }
            Line::OverLimit(text) => inner.remember(who, text, false),
            // The log already says that it takes no more lines of programs.
            Line::Omitted(_) if inner.program_bytes_left.is_none() => {}
            Line::Omitted(count) => inner.write(who, &format!("… ({count} lines left out: too many at once)")),
        }
    }

    /// Writes those of the last lines of `who` that were left out: they say why it has failed.
    pub(super) fn write_left_out(&self, who: &str) {
        let mut inner = self.lock();
        for kept in inner.last.remove(who).unwrap_or_default() {
            if !kept.is_in_log {
                inner.write(who, &kept.text);
            }
            inner.remember(who, &kept.text, true);
        }
    }

    /// The last lines that `who` wrote.
    pub(super) fn last_lines(&self, who: &str) -> Vec<String> {
        let inner = self.lock();
        let last = inner.last.get(who).into_iter().flatten();
        last.map(|kept| kept.text.clone()).collect()
    }

    fn lock(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Inner {
    /// Whether the log has room for this line of another program. Logs once that it has none.
    fn takes(&mut self, line: &str) -> bool {
        let Some(left) = self.program_bytes_left else {
            return false;
        };
        self.program_bytes_left = left.checked_sub(line.len() as u64 + 1);
        if self.program_bytes_left.is_none() {
            let what = "this log takes no more of what other programs write to standard error (SHOAL_LOG=debug logs everything)";
            self.write("launcher", what);
        }
        self.program_bytes_left.is_some()
    }

    fn remember(&mut self, who: &str, text: &str, is_in_log: bool) {
        let last = self.last.entry(who.into()).or_default();
        if last.len() == KEPT {
            last.pop_front();
        }
        last.push_back(KeptLine {
            text: text.into(),
            is_in_log,
        });
    }

    /// Writes a line, with the time if it has none of its own.
    fn write(&mut self, who: &str, line: &str) {
        let time = if has_time(line) { String::new() } else { now() };
        // A log that cannot be written must not end the run.
        let _ = writeln!(self.file, "{who:<14} {time}{line}");
    }
}

/// The time in UTC with a space behind it, as the roles write it: `2026-11-28T04:12:57.123456Z `.
fn now() -> String {
    let mut text = String::new();
    // Writing into a string does not fail.
    let _ = SystemTime.format_time(&mut format::Writer::new(&mut text));
    text + " "
}

/// Whether the line begins with such a time.
fn has_time(line: &str) -> bool {
    let form = "0000-00-00T00:00:00";
    let fits = |(found, wanted): (u8, u8)| found == wanted || (wanted == b'0' && found.is_ascii_digit());
    line.len() > form.len() && line.bytes().zip(form.bytes()).all(fits)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn log_in(directory: &Path) -> (Log, impl Fn() -> String) {
        let path = directory.join("shoal.log");
        (Log::open(&path).unwrap(), move || {
            std::fs::read_to_string(&path).unwrap()
        })
    }

    #[test]
    fn each_line_has_one_readable_time() {
        let directory = tempfile::tempdir().unwrap();
        let (log, text) = log_in(directory.path());
        log.note("launcher", "every role is ready");
        let own = "2026-11-28T04:12:57.123456Z DEBUG sent a chunk rows=8";
        log.line("actor-0", Line::Kept(own), OutputSource::Shoal);
        log.line("actor-0", Line::Kept("error: no"), OutputSource::Shoal);
        let (text, year) = (text(), &now()[..5]);
        let lines: Vec<_> = text.lines().collect();
        assert!(lines[0].starts_with(&format!("launcher       {year}")) && lines[0].ends_with("Z every role is ready"));
        assert_eq!(lines[1], format!("actor-0        {own}"));
        assert!(
            has_time(&lines[2][15..]) && lines[2].ends_with("Z error: no"),
            "{}",
            lines[2]
        );
        assert_eq!(log.last_lines("actor-0"), [own, "error: no"]);
    }

    #[test]
    fn the_lines_of_other_programs_have_a_limit_and_the_last_ones_do_not_get_lost() {
        let directory = tempfile::tempdir().unwrap();
        let (log, text) = log_in(directory.path());
        let line = "x".repeat(4000);
        for _ in 0..10_000 {
            log.line("env-server-0", Line::Kept(&line), OutputSource::Program);
        }
        log.line("env-server-0", Line::Kept("ValueError: too hot"), OutputSource::Program);
        log.line("learner-0", Line::Kept("mine"), OutputSource::Shoal);
        assert!((MAX_LOG_BYTES - 5000..MAX_LOG_BYTES + 500_000).contains(&(text().len() as u64)));
        assert!(!text().contains("too hot") && text().contains("mine"));
        assert_eq!(text().matches("this log takes no more").count(), 1);
        assert_eq!(log.last_lines("env-server-0").pop().unwrap(), "ValueError: too hot");
        for _ in 0..2 {
            log.write_left_out("env-server-0");
            assert_eq!(text().matches("too hot").count(), 1);
        }
        log.line(
            "env-server-1",
            Line::OverLimit("too much at once"),
            OutputSource::Program,
        );
        assert!(!text().contains("too much at once"));
        log.write_left_out("env-server-1");
        assert!(text().contains("too much at once"));
        // A launcher that continues the run has a little left.
        let (log, text) = log_in(directory.path());
        log.line("env-server-0", Line::Kept("again"), OutputSource::Program);
        assert!(text().contains("again"));
    }

    #[test]
    fn a_line_that_fills_the_log_exactly_is_logged_and_the_next_one_is_announced_as_left_out() {
        let directory = tempfile::tempdir().unwrap();
        let (log, text) = log_in(directory.path());
        let line = "x".repeat(1024 * 1024 - 1);
        let program_line = |line: &str| log.line("env-server-0", Line::Kept(line), OutputSource::Program);
        (0..16).for_each(|_| program_line(&line));
        assert_eq!(text().matches(&line).count(), 16);
        assert!(!text().contains("this log takes no more"));
        program_line("one more");
        program_line("");
        assert!(!text().contains("one more"));
        assert_eq!(text().matches("this log takes no more").count(), 1);
        assert_eq!(text().lines().count(), 17);
    }
}
