//! A training run as a child process, and the times of its events. It is polled every millisecond.

use std::collections::HashSet;
use std::path::PathBuf;
use std::process::Command;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use shoal_common::channel::Domain;
use shoal_common::channel::policy::PolicyReader;
use shoal_common::channel::reports::Reports;
use shoal_common::commit::CommitReader;
use shoal_common::report::Heartbeat;
use shoal_common::role::Role;
use shoal_common::run_dir::RunDir;
use shoal_run::child_process::{ChildProcess, tied};
use shoal_run::client::RunClient;
use tempfile::TempDir;

use super::super::measurement::TimeBudget;
use super::super::progress::{POLL_INTERVAL, newest, policy_reader};

/// How long a learner runs before it is killed, so that the launcher has received its heartbeat.
const SETTLING_TIME: Duration = Duration::from_millis(700);

/// Longest wait for any event. A run that takes longer hangs.
const TIMEOUT: Duration = Duration::from_secs(60);

/// A running training process.
pub(super) struct Training {
    launcher: ChildProcess,
    started_at: Instant,
    /// Incarnation of the newest learner seen.
    incarnation: u64,
    observer: Option<Observer>,
    directory: TempDir,
}

/// Access to the run's configuration, status, heartbeats and policies.
struct Observer {
    client: RunClient,
    heartbeats: Reports<Heartbeat>,
    policies: PolicyReader,
    domain: Domain,
}

/// Times of a run's first events, from the start of its launcher.
pub(super) struct Startup {
    pub(super) ready: Duration,
    first_row: Duration,
    pub(super) warm: Duration,
    pub(super) update: Duration,
    pub(super) warm_up_rows: u64,
}

/// Times of a recovery, from the kill of the learner.
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
    /// Starts the preset `pendulum` with its settings, but a much larger number of steps.
    pub(super) fn start() -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new()
            .prefix("shoal-bench-")
            .tempdir()
            .context("cannot make a temporary directory")?;
        let mut command = Command::new("/proc/self/exe");
        command.args(["train", "pendulum", "--quiet", "--seed", "1"]);
        command.args(["--set", "run.steps=1_000_000_000_000", "--run"]);
        command.arg(directory.path().join("run"));
        // Tied to this process: if that is killed, the training, which has no end, ends.
        let mut command = tied(&command).context("cannot start a training")?;
        let started_at = Instant::now();
        let launcher = ChildProcess::start(&mut command, "training".into()).context("cannot start a training")?;
        Ok(Self {
            launcher,
            started_at,
            incarnation: 0,
            observer: None,
            directory,
        })
    }

    /// Ends the training in order and removes its files.
    pub(super) fn end(self) -> anyhow::Result<()> {
        let ended = self.launcher.interrupt(TIMEOUT);
        // The last process to leave removes the run from shared memory.
        let left = match self.observer {
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

    /// Observes the run until the first policy that gradient steps have changed.
    pub(super) fn begin(&mut self, budget: &TimeBudget) -> anyhow::Result<Startup> {
        let run = RunDir::at(&self.directory.path().join("run"));
        let begun = self.started_at;
        // Joining before the launcher would look like the remains of an earlier run. The launcher writes this file
        // before it starts the first process, and has created the services by then.
        let counter = run.incarnations();
        self.wait(budget, "no process", |_| Ok(counter.exists().then_some(())))?;
        let mut observer = Observer::open(&run)?;
        let actors = observer.client.config.actors.count;
        let roles = 3 + 2 * actors as usize;
        let warm_up_rows = observer.client.config.replay.warmup;

        let (mut seen, mut commits) = (HashSet::new(), None);
        let (mut ready, mut first_row, mut warm, mut update) = (None, None, None, None);
        let began = self.wait(budget, "no update", |incarnation| {
            while let Some(heartbeat) = observer.heartbeats.receive()? {
                seen.insert((heartbeat.role(), heartbeat.index));
            }
            if commits.is_none() {
                commits = CommitReader::open_if_ready(&run.replay_file())?;
            }
            let rows = commits.as_ref().map_or(0, |commits| commits.rows());
            let header = newest(&mut observer.policies)?;
            let now = begun.elapsed();
            let note = |event: &mut Option<Duration>, has_occurred: bool| {
                if has_occurred {
                    event.get_or_insert(now);
                }
            };
            note(&mut ready, seen.len() == roles);
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
        self.observer = Some(observer);
        began
    }

    /// Lets the run work for a while.
    pub(super) fn settle(&mut self, budget: &TimeBudget) -> anyhow::Result<()> {
        let started_at = Instant::now();
        self.wait(budget, "no steady state", |_| {
            Ok((started_at.elapsed() >= SETTLING_TIME).then_some(()))
        })
    }

    /// Role, index and process id of every process.
    pub(super) fn processes(&self) -> anyhow::Result<Vec<(Role, u32, u32)>> {
        let status = self.observer()?.client.status()?.context("the training has ended")?;
        let processes = status.roles.into_iter();
        Ok(processes
            .filter_map(|role| Some((role.role, role.index, role.pid?)))
            .collect())
    }

    /// The path of the replay file.
    pub(super) fn replay(&self) -> anyhow::Result<PathBuf> {
        Ok(self.observer()?.client.run.replay_file())
    }

    /// Observes the run until the successor of the learner killed at `killed` has made gradient steps.
    pub(super) fn recover(&mut self, killed: Instant, budget: &TimeBudget) -> anyhow::Result<Recovery> {
        let mut observer = self.observer.take().context("the training is not being observed")?;
        let (mut ready, mut first, before) = (None, None, self.incarnation);
        let came = self.wait(budget, "no update of the learner's successor", |incarnation| {
            while let Some(heartbeat) = observer.heartbeats.receive()? {
                if heartbeat.role() == Some(Role::Learner) && heartbeat.incarnation > before {
                    ready.get_or_insert(killed.elapsed());
                }
            }
            let header = newest(&mut observer.policies)?.filter(|header| header.incarnation > before);
            let Some(header) = header else { return Ok(None) };
            // The successor's first policy is the checkpoint's.
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
        self.observer = Some(observer);
        came
    }

    fn observer(&self) -> anyhow::Result<&Observer> {
        self.observer.as_ref().context("the training is not being observed")
    }

    /// Polls until `look` returns something. Returns an error if that takes too long, the training ends, or the user
    /// interrupts.
    fn wait<T>(
        &mut self,
        budget: &TimeBudget,
        missing: &str,
        mut look: impl FnMut(&mut u64) -> anyhow::Result<Option<T>>,
    ) -> anyhow::Result<T> {
        let started_at = Instant::now();
        loop {
            if let Some(found) = look(&mut self.incarnation)? {
                return Ok(found);
            }
            budget.check()?;
            self.launcher.check()?;
            if started_at.elapsed() >= TIMEOUT {
                bail!("the training showed {missing} for {} s", TIMEOUT.as_secs());
            }
            std::thread::sleep(POLL_INTERVAL);
        }
    }
}

impl Observer {
    fn open(run: &RunDir) -> anyhow::Result<Self> {
        let client = RunClient::open(run.path())?;
        let domain = Domain::join(&client.config.run.id, client.config.actors.max_on_a_host())?;
        Ok(Self {
            heartbeats: Reports::open(&domain)?,
            policies: policy_reader(&client.config, &domain)?,
            client,
            domain,
        })
    }
}
