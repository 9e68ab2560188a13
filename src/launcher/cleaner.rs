//! Cleaning up in shared memory after the dead, in a process of its own: iceoryx2 has no time limit there that holds, and a
//! launcher that hangs could not even be stopped.

use std::os::unix::process::CommandExt;
use std::process::{Command, ExitCode, ExitStatus};
use std::time::Duration;

use anyhow::{Context, bail};
use rustix::process::{Signal, set_parent_process_death_signal};
use shoal_common::channel::{Domain, Services};
use shoal_run::process::ChildGroup;

/// The command that does it. Its argument is the run's name.
pub(crate) const COMMAND: &str = "clean-up";

/// How long a clean-up may take: it takes some milliseconds.
const PATIENCE: Duration = Duration::from_secs(2);

/// Clean-ups that are tried, where one is killed itself.
const TRIES: u32 = 3;

/// Has a process clean up after those that are no more.
///
/// # Errors
/// When it cannot be done now; it can be tried again.
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
        Some(status) => bail!("cleaning up in shared memory did not succeed: {status}"),
        None => bail!("cleaning up in shared memory took longer than {PATIENCE:?}"),
    }
}

/// How the process ended; `None` where it had to be ended.
fn run(run_id: &str) -> anyhow::Result<Option<ExitStatus>> {
    let mut command = Command::new("/proc/self/exe");
    command.arg0("shoal").args([COMMAND, run_id]);
    // What it writes is lost: its exit code says all.
    let (mut child, _, _) = ChildGroup::start(&mut command).context("cannot start a process that cleans up")?;
    Ok(child.wait(PATIENCE))
}

/// What that process does.
///
/// # Errors
/// When files cannot be listed or removed.
pub(crate) fn work(run_id: &str) -> anyhow::Result<ExitCode> {
    set_parent_process_death_signal(Some(Signal::KILL)).context("cannot be tied to the launcher")?;
    match Domain::clean_up(run_id)? {
        0 => Ok(ExitCode::SUCCESS),
        _ => Ok(ExitCode::FAILURE),
    }
}
