//! The roles of an earlier launcher, which was killed: until they have ended, they may use the run's files.

use std::time::Duration;

use shoal_common::channel::{Domain, DomainError};
use shoal_common::role::Role;
use shoal_common::run_dir::{LockedRun, RunDir};
use shoal_common::stop::GRACE;
use shoal_run::records::outcome::{OutcomeReason, RunOutcome, RunState};

use super::record_failure_if_open;

/// How long the roles of a killed launcher may take to end. One that is stuck ends after [`GRACE`].
const PREDECESSORS_TIMEOUT: Duration = GRACE.saturating_add(Duration::from_secs(5));

/// Waits until the roles of an earlier launcher, which was killed, have ended. Until then they may read and write the
/// run's files.
///
/// # Errors
/// When some do not end. That is recorded as the run's outcome.
pub(crate) fn wait_for_predecessors(run_id: &str, run: &LockedRun) -> anyhow::Result<()> {
    if Domain::wait_for_earlier_processes(run_id, Duration::ZERO).is_ok() {
        return Ok(());
    }
    if let Some(outcome) = RunOutcome::read(run)?.filter(|outcome| outcome.state == RunState::Running) {
        // For `shoal status`, which nobody answers until there is a launcher.
        outcome.with_reason(OutcomeReason::Starting).write(run)?;
    }
    let waited = Domain::wait_for_earlier_processes(run_id, PREDECESSORS_TIMEOUT);
    waited
        .map_err(|error| name_original_run(error, run))
        .inspect_err(|error| record_failure_if_open(run, error))
}

/// Waits as [`wait_for_predecessors`] does, but records nothing. If this directory is a copy of another run, the roles
/// of that run do not count: they use their own directory.
///
/// # Errors
/// When some do not end.
pub(crate) fn wait_for_roles_here(run_id: &str, run: &RunDir) -> anyhow::Result<()> {
    let is_another = |error: &DomainError| original_run(error, run).is_some();
    let wait = |timeout| match Domain::wait_for_earlier_processes(run_id, timeout) {
        Err(error) if !is_another(&error) => Err(error),
        _ => Ok(()),
    };
    Ok(wait(Duration::ZERO).or_else(|_| wait(PREDECESSORS_TIMEOUT))?)
}

/// Names the original run in the error, if this directory is a copy and the surviving processes belong to the original.
fn name_original_run(error: DomainError, run: &RunDir) -> anyhow::Error {
    match original_run(&error, run) {
        Some(there) => {
            let here = run.path().display();
            anyhow::anyhow!("{here} is a copy of {there}, which is running: stop that run first")
        }
        None => error.into(),
    }
}

/// The directory of the surviving processes, if they belong to a run that this directory is a copy of.
fn original_run(error: &DomainError, run: &RunDir) -> Option<String> {
    let DomainError::StillAlive { pids, .. } = error else {
        return None;
    };
    // Only roles name their directory in a fixed place: their arguments are role, run directory and two numbers.
    let directory = |pid: &i32| {
        let arguments = std::fs::read(format!("/proc/{pid}/cmdline")).ok()?;
        let arguments = String::from_utf8_lossy(&arguments);
        let mut arguments = arguments.split('\0').skip(1);
        let is_role = Role::from_name(arguments.next()?).is_some();
        arguments.next().filter(|_| is_role).map(str::to_owned)
    };
    let here = run.path().display().to_string();
    pids.iter().find_map(directory).filter(|there| *there != here)
}
