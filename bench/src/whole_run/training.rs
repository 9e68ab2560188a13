//! A training that is a child of this process, and when what happens in it. It is looked at every millisecond.

use std::collections::HashSet;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use shoal_common::channel::Domain;
use shoal_common::channel::policy::PolicyReader;
use shoal_common::channel::reports::Reports;
use shoal_common::report::{Heartbeat, Role};
use shoal_common::run_dir::RunDir;
use shoal_run::process::Peer;
use shoal_run::remote::Remote;
use tempfile::TempDir;

use super::super::flow::{LOOK, commits_of, newest, policy_reader};
use super::super::measurement::Patience;

/// How long a learner is at work before it is killed: the launcher has heard of it by then.
const SETTLED: Duration = Duration::from_millis(700);

/// How long anything may take. What takes longer hangs.
const PATIENCE: Duration = Duration::from_secs(60);

/// A training that goes on.
pub(super) struct Training {
    launcher: Peer,
    begun: Instant,
    /// Of the learner that was seen last.
    incarnation: u64,
    seat: Option<Observer>,
    directory: TempDir,
}

/// What is needed to look on.
struct Observer {
    remote: Remote,
    heartbeats: Reports<Heartbeat>,
    policies: PolicyReader,
    domain: Domain,
}

/// When a run had come how far, since its launcher was started.
pub(super) struct Startup {
    pub(super) ready: Duration,
    first_row: Duration,
    pub(super) warm: Duration,
    pub(super) update: Duration,
    pub(super) warm_up_rows: u64,
}

/// When a learner that was killed was replaced, since then.
pub(super) struct Recovery {
    pub(super) ready: Duration,
    pub(super) update: Duration,
}

impl Startup {
    pub(super) fn warm_up(&self) -> Duration {
        self.warm - self.first_row
    }
}

impl Training {
    /// Starts the preset `pendulum` as it is, but for its length.
    pub(super) fn start() -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new()
            .prefix("shoal-bench-")
            .tempdir()
            .context("cannot make a temporary directory")?;
        let mut command = Command::new("/proc/self/exe");
        command
            .arg0("shoal")
            .args(["train", "pendulum", "--quiet", "--seed", "1"]);
        command.args(["--set", "run.steps=1_000_000_000_000", "--run"]);
        command.arg(directory.path().join("run"));
        let begun = Instant::now();
        let launcher = Peer::start(&mut command, "training".into()).context("cannot start a training")?;
        Ok(Self {
            launcher,
            begun,
            incarnation: 0,
            seat: None,
            directory,
        })
    }

    /// Ends the training in order, and removes what it left.
    pub(super) fn end(self) -> anyhow::Result<()> {
        let ended = self.launcher.interrupt(PATIENCE);
        // Whoever is the last to leave removes the run from shared memory.
        let left = match self.seat {
            None => Ok(()),
            Some(Observer {
                heartbeats,
                policies,
                domain,
                ..
            }) => {
                drop((heartbeats, policies));
                domain.leave()
            }
        };
        let removed = self.directory.close();
        ended?;
        left?;
        removed.context("cannot remove a temporary directory")
    }

    /// Looks on until the first policy that updates have changed.
    pub(super) fn begin(&mut self, patience: &Patience) -> anyhow::Result<Startup> {
        let run = RunDir::planned(&self.directory.path().join("run"));
        let begun = self.begun;
        // Who joins before the launcher has would be taken for what another launcher left; and the services are there when the
        // first process is started, whose number is written down before.
        let counter = run.incarnations();
        self.wait(patience, "no process", |_| Ok(counter.exists().then_some(())))?;
        let mut seat = Observer::take(&run)?;
        let actors = seat.remote.config.actors.count;
        let roles = 3 + 2 * actors as usize;
        let warm_up_rows = seat.remote.config.replay.warmup;

        let (mut heard, mut commits) = (HashSet::new(), None);
        let (mut ready, mut first_row, mut warm, mut update) = (None, None, None, None);
        let began = self.wait(patience, "no update", |incarnation| {
            while let Some(heartbeat) = seat.heartbeats.receive()? {
                heard.insert((heartbeat.role(), heartbeat.index));
            }
            if commits.is_none() {
                commits = commits_of(&run)?;
            }
            let rows = commits.as_ref().map_or(0, |commits| commits.rows());
            let header = newest(&mut seat.policies)?;
            let now = begun.elapsed();
            let note = |event: &mut Option<Duration>, has_come: bool| {
                if has_come {
                    event.get_or_insert(now);
                }
            };
            note(&mut ready, heard.len() == roles);
            note(&mut first_row, rows > 0);
            note(&mut warm, rows >= warm_up_rows);
            note(&mut update, header.is_some_and(|header| header.updates > 0));
            *incarnation = header.map_or(0, |header| header.incarnation);
            let all = ready.zip(first_row).zip(warm).zip(update);
            Ok(all.map(|(((ready, first_row), warm), update)| Startup {
                ready,
                first_row,
                warm,
                update,
                warm_up_rows,
            }))
        });
        self.seat = Some(seat);
        began
    }

    /// Waits until the run is at work for a while.
    pub(super) fn settle(&mut self, patience: &Patience) -> anyhow::Result<()> {
        let begun = Instant::now();
        self.wait(patience, "no rest", |_| Ok((begun.elapsed() >= SETTLED).then_some(())))
    }

    /// Role, index and number of every process.
    pub(super) fn members(&self) -> anyhow::Result<Vec<(String, u32, u32)>> {
        let status = self.seat()?.remote.status()?.context("the training has ended")?;
        let members = status.roles.into_iter();
        Ok(members
            .filter_map(|role| Some((role.role, role.index, role.pid?)))
            .collect())
    }

    /// The file that the replay is.
    pub(super) fn replay(&self) -> anyhow::Result<PathBuf> {
        Ok(self.seat()?.remote.run.replay_file())
    }

    /// Looks on until the successor of a learner that was killed then has made updates.
    pub(super) fn recover(&mut self, killed: Instant, patience: &Patience) -> anyhow::Result<Recovery> {
        let mut seat = self.seat.take().context("nobody looks on")?;
        let (mut ready, mut first, before) = (None, None, self.incarnation);
        let came = self.wait(patience, "no update of the learner's successor", |incarnation| {
            while let Some(heartbeat) = seat.heartbeats.receive()? {
                if heartbeat.role() == Some(Role::Learner) && heartbeat.incarnation > before {
                    ready.get_or_insert(killed.elapsed());
                }
            }
            let header = newest(&mut seat.policies)?.filter(|header| header.incarnation > before);
            let Some(header) = header else { return Ok(None) };
            // Its first policy is that of the checkpoint.
            let restored = *first.get_or_insert(header.updates);
            let is_changed = header.updates > restored;
            Ok(ready.filter(|_| is_changed).map(|ready| {
                *incarnation = header.incarnation;
                Recovery {
                    ready,
                    update: killed.elapsed(),
                }
            }))
        });
        self.seat = Some(seat);
        came
    }

    fn seat(&self) -> anyhow::Result<&Observer> {
        self.seat.as_ref().context("nobody looks on")
    }

    /// Looks until there is something; an error when that takes too long, or the training ends, or somebody asks for the end.
    fn wait<T>(
        &mut self,
        patience: &Patience,
        missing: &str,
        mut look: impl FnMut(&mut u64) -> anyhow::Result<Option<T>>,
    ) -> anyhow::Result<T> {
        let begun = Instant::now();
        loop {
            if let Some(found) = look(&mut self.incarnation)? {
                return Ok(found);
            }
            patience.check()?;
            self.launcher.check()?;
            if begun.elapsed() >= PATIENCE {
                bail!("the training showed {missing} for {} s", PATIENCE.as_secs());
            }
            std::thread::sleep(LOOK);
        }
    }
}

impl Observer {
    fn take(run: &RunDir) -> anyhow::Result<Self> {
        let remote = Remote::open(run.path())?;
        let domain = Domain::join(&remote.config.run.id, remote.config.actors.max)?;
        Ok(Self {
            heartbeats: Reports::open(&domain)?,
            policies: policy_reader(&remote.config, &domain)?,
            remote,
            domain,
        })
    }
}
