//! Cleans up shared memory after dead processes. This happens in a child process, because iceoryx2 has no reliable time
//! limit for it and a launcher that hangs could not be stopped.

use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode, ExitStatus};
use std::time::Duration;

use anyhow::{Context, bail};
use shoal_common::channel::{Domain, Services};
use shoal_run::child_process::{ChildGroup, tie_to_parent};

/// The hidden command of that child process. Its arguments are this process's id and the run's id.
pub(crate) const COMMAND: &str = "clean-up";

/// How long a clean-up may take. Usually it takes a few milliseconds.
const TIMEOUT: Duration = Duration::from_secs(2);

/// Number of attempts, for the case that a clean-up is killed itself.
const TRIES: u32 = 3;

/// Starts a process that cleans up after dead processes, and waits for it.
///
/// # Errors
/// When the clean-up fails. It can be tried again.
pub(super) fn clean_up(domain: &Domain, services: &Services) -> anyhow::Result<()> {
    let mut last = None;
    for _ in 0..TRIES {
        services.restore_port_tags(domain)?;
        let status = run(domain.run_id())?;
        match status {
            Some(status) if status.success() => return Ok(()),
            other => last = other,
        }
    }
    match last {
        Some(status) => bail!("cleaning up shared memory failed: {status}"),
        None => bail!("cleaning up shared memory took longer than {TIMEOUT:?}"),
    }
}

/// How the process ended; `None` if it took too long and is killed.
fn run(run_id: &str) -> anyhow::Result<Option<ExitStatus>> {
    let mut command = Command::new("/proc/self/exe");
    command
        .arg0("shoal")
        .args([COMMAND, &std::process::id().to_string(), run_id]);
    // Its output is discarded; the exit code is enough.
    let (mut child, _, _) = ChildGroup::start(&mut command).context("cannot start a process that cleans up")?;
    Ok(child.wait(TIMEOUT))
}

/// The clean-up itself, in the child process. `launcher` is the process id of its parent.
///
/// # Errors
/// When the launcher has died, or files cannot be listed or removed.
pub(crate) fn run_in_child(launcher: u32, run_id: &str) -> anyhow::Result<ExitCode> {
    tie_to_parent(launcher)?;
    match Domain::clean_up(run_id)? {
        0 => Ok(ExitCode::SUCCESS),
        _ => Ok(ExitCode::FAILURE),
    }
}
