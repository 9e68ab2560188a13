//! The progress of a measured run: rows from its commit record, gradient steps from the published policies.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::bail;
use shoal_common::channel::Domain;
use shoal_common::channel::policy::{PolicyHeader, PolicyReader};
use shoal_common::commit::CommitReader;
use shoal_common::config::Config;

use super::measurement::TimeBudget;
use super::processes::Processes;
use super::temporary_run::TemporaryRun;

/// Time between two polls.
pub(super) const POLL_INTERVAL: Duration = Duration::from_millis(1);

/// How long processes may take to be ready.
pub(super) const STARTUP_TIMEOUT: Duration = Duration::from_secs(60);

/// The counters of a run in which every actor sends rows.
#[derive(Debug)]
pub(super) struct RunProgress<'a> {
    temporary: &'a TemporaryRun,
    commits: CommitReader,
    policies: PolicyReader,
}

impl<'a> RunProgress<'a> {
    /// Waits until rows of every actor are committed.
    pub(super) fn begin(
        temporary: &'a TemporaryRun,
        domain: &Domain,
        processes: &mut Processes,
        budget: &TimeBudget,
    ) -> anyhow::Result<Self> {
        let policies = policy_reader(&temporary.config, domain)?;
        let begun = Instant::now();
        let commits = wait_for_replay(&temporary.run.replay_file(), || {
            processes.check()?;
            budget.check()
        })?;
        // The handshake has sequence number 0.
        let has_sent = |actor: u32| commits.committed(actor as usize).sequence > 0;
        while !(0..temporary.config.actors.count).all(has_sent) {
            processes.check()?;
            budget.check()?;
            if begun.elapsed() >= STARTUP_TIMEOUT {
                bail!("not every actor had sent rows after {} s", STARTUP_TIMEOUT.as_secs());
            }
            std::thread::sleep(POLL_INTERVAL);
        }
        Ok(Self {
            temporary,
            commits,
            policies,
        })
    }

    /// Rows committed.
    pub(super) fn rows(&self) -> u64 {
        self.commits.rows()
    }

    /// Gradient steps that led to the newest policy.
    pub(super) fn updates(&mut self) -> anyhow::Result<u64> {
        Ok(newest(&mut self.policies)?.map_or(0, |header| header.updates))
    }

    /// Sleeps for `length`. Returns an error early if the user interrupts or a role ends.
    pub(super) fn sleep(&self, length: Duration, processes: &mut Processes, budget: &TimeBudget) -> anyhow::Result<()> {
        let begun = Instant::now();
        loop {
            budget.check()?;
            processes.check()?;
            let left = length.saturating_sub(begun.elapsed());
            if left.is_zero() {
                return Ok(());
            }
            std::thread::sleep(left.min(Duration::from_millis(50)));
        }
    }

    /// Whether the run's learner makes gradient steps.
    pub(super) fn expects_updates(&self) -> bool {
        self.temporary.config.replay.updates_per_step > 0.0
    }
}

/// Waits for a replay, or for a copy of its commit record. `check` ends the wait by an error.
pub(super) fn wait_for_replay(
    path: &Path,
    mut check: impl FnMut() -> anyhow::Result<()>,
) -> anyhow::Result<CommitReader> {
    let begun = Instant::now();
    loop {
        if let Some(reader) = CommitReader::open_if_ready(path)? {
            return Ok(reader);
        }
        if begun.elapsed() >= STARTUP_TIMEOUT {
            bail!("{} was not made within {} s", path.display(), STARTUP_TIMEOUT.as_secs());
        }
        check()?;
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Opens a reader of the run's policies. The service allows one reader besides the roles.
pub(super) fn policy_reader(config: &Config, domain: &Domain) -> anyhow::Result<PolicyReader> {
    let layout = config.policy_layout()?;
    Ok(PolicyReader::open(domain, layout.fingerprint(), layout.parameters())?)
}

/// The header of the newest policy, or `None` before the first. The learner publishes one every few gradient steps.
pub(super) fn newest(policies: &mut PolicyReader) -> anyhow::Result<Option<PolicyHeader>> {
    Ok(policies.latest()?.map(|policy| *policy.header()))
}
