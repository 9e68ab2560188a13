//! The Python package `shoal`, whose modules use other packages of Python.

use std::process::{Command, Stdio};

use anyhow::{Context, bail};

/// `python3 -m MODULE`, if `python3` has that module.
///
/// # Errors
/// When `python3` cannot be started, or lacks the module: the package is not installed, or is an older one.
pub fn module(name: &str) -> anyhow::Result<Command> {
    let mut python = Command::new("python3");
    python.args(["-c", &format!("import {name}")]);
    python.stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let status = python.status();
    let status = status.context("cannot start python3: install Python, or add it to PATH")?;
    if !status.success() {
        bail!("python3 has no package shoal with {name}: pip install ./python, in Shoal's directory");
    }
    let mut command = Command::new("python3");
    command.args(["-m", name]);
    Ok(command)
}
