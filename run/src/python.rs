//! The Python package `shoal`, whose modules use other packages of Python.

use std::process::{Command, Stdio};

use anyhow::bail;

/// `python3 -m MODULE`, if `python3` has that module.
///
/// # Errors
/// When it has not: the package is not installed, or is an older one.
pub fn module(name: &str) -> anyhow::Result<Command> {
    let mut python = Command::new("python3");
    python.args(["-c", &format!("import {name}")]);
    python.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    if !python.status().is_ok_and(|status| status.success()) {
        bail!("python3 has no package shoal with {name}: pip install ./python, in Shoal's directory");
    }
    let mut command = Command::new("python3");
    command.args(["-m", name]);
    Ok(command)
}
