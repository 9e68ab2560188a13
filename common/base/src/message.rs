//! Messages to the user on standard error.

use std::fmt::Display;
use std::io::Write;

/// Writes a line to standard error. A failure is ignored: the work must not fail because its terminal was closed.
pub fn say(line: impl Display) {
    let _ = writeln!(std::io::stderr(), "{line}");
}

/// The error on one line; one of `anyhow` with its causes.
pub fn one_line(error: impl Display) -> String {
    format!("{error:#}").replace('\n', " ")
}
