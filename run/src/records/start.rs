//! How, when and where a run or a suite was started: `start.json` in its directory.

use std::ffi::OsString;
use std::path::Path;
use std::time::SystemTime;

use serde::{Deserialize, Serialize};
use shoal_common::versioned_file::VersionedFile;

/// The name of the file.
pub(crate) const FILE: &str = "start.json";

/// How, when and where a run or a suite was started.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct StartRecord {
    /// The command line, as a shell takes it.
    pub command: String,
    /// The version of this program.
    pub version: String,
    /// Seconds since 1970.
    pub started: u64,
    /// The name of the processor; `None` if the system does not state it.
    pub processor: Option<String>,
    /// Processor cores that this process may use; `None` if that is unknown.
    pub cores: Option<usize>,
}

impl VersionedFile for StartRecord {
    const FORMAT: u32 = 1;
    const IF_DAMAGED: &'static str = "; delete it: nothing else depends on it";
}

impl StartRecord {
    /// A start by this process, now.
    pub fn of_this_process() -> Self {
        Self {
            command: command_line(std::env::args_os().skip(1)),
            version: env!("CARGO_PKG_VERSION").into(),
            started: SystemTime::UNIX_EPOCH.elapsed().map_or(0, |since| since.as_secs()),
            processor: std::fs::read_to_string("/proc/cpuinfo")
                .ok()
                .and_then(|text| processor(&text)),
            cores: std::thread::available_parallelism().ok().map(usize::from),
        }
    }

    /// The record of the run or suite in this directory; `None` if there is none, as in runs and suites of earlier
    /// versions.
    ///
    /// # Errors
    /// When the file cannot be read, is damaged or has another format.
    pub fn read(directory: &Path) -> anyhow::Result<Option<Self>> {
        Ok(Self::load_if_any(&directory.join(FILE))?)
    }

    /// Writes it into the directory of a run or a suite.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, directory: &Path) -> anyhow::Result<()> {
        Ok(self.store(&directory.join(FILE))?)
    }
}

/// The name of the first processor in the text of `/proc/cpuinfo`.
fn processor(cpuinfo: &str) -> Option<String> {
    let named = cpuinfo.lines().filter_map(|line| line.split_once(':'));
    let mut names = named.filter(|(key, _)| key.trim() == "model name");
    names.next().map(|(_, name)| name.trim().to_owned())
}

/// `shoal` with these arguments, quoted where a shell needs it.
fn command_line(arguments: impl Iterator<Item = OsString>) -> String {
    let is_plain = |c: char| c.is_alphanumeric() || "=,._-+/:@%".contains(c);
    let words = arguments.map(|argument| {
        let word = argument.to_string_lossy();
        if !word.is_empty() && word.chars().all(is_plain) {
            word.into_owned()
        } else {
            format!("'{}'", word.replace('\'', r"'\''"))
        }
    });
    std::iter::once("shoal".into())
        .chain(words)
        .collect::<Vec<_>>()
        .join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_can_be_given_to_a_shell() {
        let arguments = ["train", "pendulum", "--set", "ddpg.hidden=[64, 48]", "", "it's", "a$b"];
        let line = command_line(arguments.map(OsString::from).into_iter());
        assert_eq!(
            line,
            r"shoal train pendulum --set 'ddpg.hidden=[64, 48]' '' 'it'\''s' 'a$b'"
        );
        let shell = std::process::Command::new("sh")
            .args(["-c", &format!("shoal() {{ printf '%s|' \"$@\"; }}; {line}")])
            .output()
            .unwrap();
        assert_eq!(String::from_utf8_lossy(&shell.stdout), arguments.join("|") + "|");
    }

    #[test]
    fn a_processor_has_the_name_that_the_system_states() {
        let text = "processor\t: 0\nmodel name\t: Some: CPU @ 3 GHz\n\nprocessor\t: 1\nmodel name\t: Other\n";
        assert_eq!(processor(text).as_deref(), Some("Some: CPU @ 3 GHz"));
        assert_eq!(processor("processor : 0\nBogoMIPS : 50\n"), None);
    }

    #[test]
    fn a_record_is_read_as_it_was_written() {
        let directory = tempfile::tempdir().unwrap();
        assert_eq!(StartRecord::read(directory.path()).unwrap(), None);
        let record = StartRecord::of_this_process();
        assert!(record.command.starts_with("shoal") && record.started > 1_700_000_000);
        record.write(directory.path()).unwrap();
        assert_eq!(StartRecord::read(directory.path()).unwrap(), Some(record));
    }
}
