//! What gets through a run that is measured: rows, by its commit record, and updates, by the policies that are published.

use std::time::{Duration, Instant};

use anyhow::bail;
use shoal_common::channel::Domain;
use shoal_common::channel::policy::{PolicyHeader, PolicyReader};
use shoal_common::commit::{CommitReader, OpenError};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

use super::measurement::Patience;
use super::processes::Processes;
use super::scene::Scene;

/// How often it is looked whether something has come.
pub(super) const LOOK: Duration = Duration::from_millis(1);

/// How long a run may take until all its actors have sent rows.
const BEGINNING: Duration = Duration::from_secs(60);

/// A run whose actors all send rows.
#[derive(Debug)]
pub(super) struct Flow<'a> {
    scene: &'a Scene,
    commits: CommitReader,
    policies: PolicyReader,
}

impl<'a> Flow<'a> {
    /// Waits until rows of every actor are committed.
    pub(super) fn begin(
        scene: &'a Scene,
        domain: &Domain,
        processes: &mut Processes,
        patience: &Patience,
    ) -> anyhow::Result<Self> {
        let policies = policy_reader(&scene.config, domain)?;
        let begun = Instant::now();
        let mut commits = None;
        loop {
            processes.check()?;
            patience.check()?;
            if commits.is_none() {
                commits = commits_of(&scene.run)?;
            }
            // The first chunk is the handshake, and takes no number.
            let has_sent = |commits: &CommitReader, actor: u32| commits.committed(actor as usize).sequence > 0;
            let all = 0..scene.config.actors.count;
            match commits.take() {
                Some(commits) if all.clone().all(|actor| has_sent(&commits, actor)) => {
                    return Ok(Self {
                        scene,
                        commits,
                        policies,
                    });
                }
                there => commits = there,
            }
            if begun.elapsed() >= BEGINNING {
                bail!("not every actor had sent rows after {} s", BEGINNING.as_secs());
            }
            std::thread::sleep(LOOK);
        }
    }

    /// Rows committed.
    pub(super) fn rows(&self) -> u64 {
        self.commits.rows()
    }

    /// Updates that the newest policy was made by.
    pub(super) fn updates(&mut self) -> anyhow::Result<u64> {
        Ok(newest(&mut self.policies)?.map_or(0, |header| header.updates))
    }

    /// Sleeps, unless somebody asks for the end or a role has ended.
    pub(super) fn sleep(&self, length: Duration, processes: &mut Processes, patience: &Patience) -> anyhow::Result<()> {
        let begun = Instant::now();
        loop {
            patience.check()?;
            processes.check()?;
            let left = length.saturating_sub(begun.elapsed());
            if left.is_zero() {
                return Ok(());
            }
            std::thread::sleep(left.min(Duration::from_millis(50)));
        }
    }

    /// Whether the run's learner is to make updates.
    pub(super) fn expects_updates(&self) -> bool {
        self.scene.config.replay.updates_per_step > 0.0
    }
}

/// The run's commit record; `None` while there is none.
pub(super) fn commits_of(run: &RunDir) -> anyhow::Result<Option<CommitReader>> {
    match CommitReader::open(&run.replay_file()) {
        Ok(reader) => Ok(Some(reader)),
        Err(OpenError::NotYet { .. }) => Ok(None),
        Err(error) => Err(error.into()),
    }
}

/// Reads the run's policies. There is room for one reader besides the roles.
pub(super) fn policy_reader(config: &Config, domain: &Domain) -> anyhow::Result<PolicyReader> {
    let layout = config.algorithm.policy_layout(&config.spec)?;
    Ok(PolicyReader::open(domain, layout.fingerprint(), layout.parameters())?)
}

/// What is known of the newest policy. A learner publishes one every few updates (four).
pub(super) fn newest(policies: &mut PolicyReader) -> anyhow::Result<Option<PolicyHeader>> {
    Ok(policies.latest()?.map(|policy| *policy.header()))
}
