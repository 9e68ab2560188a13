//! The learner's process in free and lockstep runs, with its replay, algorithm, channels and checkpoints.

use std::io;
use std::ops::Range;
use std::path::Path;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use shoal_common::algorithms::TransitionUse;
use shoal_common::channel::policy::{PolicyHeader, PolicyPublisher};
use shoal_common::channel::reports::{Reporter, Reports};
use shoal_common::channel::{ChannelError, Domain, EventName, HeartbeatSender, Listener, Notifier};
use shoal_common::config::{Config, Mode};
use shoal_common::policy_file::PolicyFile;
use shoal_common::report::{Heartbeat, LearnerReport};
use shoal_common::role::{Activity, Role};
use shoal_common::stop::Stop;

use super::checkpoint::{Checkpoints, Counters};
use super::error::LearnerError;
use super::intake::Intake;
use super::settings::LearnerSettings;
use super::sizes::replay_layout;
use crate::algorithms::algorithm::{Algorithm, LossSums, SavedState};
use crate::algorithms::registry;
use crate::networks::threads::Threads;
use crate::replay::{Replay, ReplayError, ReplayLayout, SyncedRows};

const REPORT_INTERVAL: Duration = Duration::from_millis(500);

/// How often the learner looks for actors that it has no receiver for yet.
const NEW_ACTORS_INTERVAL: Duration = Duration::from_millis(100);

/// Chunks of each actor that are taken at most before the next update or, at the end, before the time is checked.
pub(crate) const CHUNKS_AT_ONCE: u32 = 8;

/// At the end, the learner takes chunks until none has arrived for this long.
const QUIET_TIME: Duration = Duration::from_millis(200);

/// At the end, the learner takes chunks for no longer than this.
const LAST_CHUNKS_TIMEOUT: Duration = Duration::from_secs(2);

/// Whether another chunk might overwrite a row that an update still needs: an algorithm that uses each row once needs
/// all rows that it has not used. After a power loss there may be no row.
pub(crate) fn would_lose_rows(config: &Config, replay: &Replay, updates: u64) -> bool {
    let uses_each_once = config.algorithm.properties().transition_use == TransitionUse::Transitions;
    let (head, ring) = (replay.head(), replay.layout().ring);
    uses_each_once
        && !replay.rows().is_empty()
        && head + config.chunk_rows() as u64 > updates + ring
        && config.replay.allowed_updates(head) > updates
}

/// The state of the learner's process.
pub(crate) struct Learner<'a> {
    pub(crate) domain: &'a Domain,
    pub(crate) settings: &'a LearnerSettings,
    pub(crate) stop: &'a Stop,
    pub(crate) listener: Listener,
    pub(crate) replay: Replay,
    pub(crate) intake: Intake,
    pub(crate) heartbeat: HeartbeatSender,
    /// Environment steps that count for the ratio: in a free run the replay's head, in lockstep the rows of complete
    /// rounds.
    pub(crate) env_steps: u64,
    /// Episodes that end within these steps.
    episodes: u64,
    algorithm: Box<dyn Algorithm>,
    pub(crate) publisher: PolicyPublisher,
    evaluator: Notifier,
    /// Version of the policy published last; in lockstep the number of complete rounds.
    pub(crate) policy_version: u64,
    checkpoints: Checkpoints,
    sync: Option<JoinHandle<io::Result<SyncedRows>>>,
    reporter: Reporter<LearnerReport>,
    /// Of the updates since the last report.
    losses: LossSums,
    reported_at: Instant,
    heartbeats: Reports<Heartbeat>,
    actors_checked_at: Instant,
}

impl<'a> Learner<'a> {
    pub(crate) fn new(domain: &'a Domain, settings: &'a LearnerSettings, stop: &'a Stop) -> Result<Self, LearnerError> {
        let (config, run) = (&settings.config, &settings.run);
        let mut algorithm = registry::new(config)?;
        if config.learner.threads > 1 {
            algorithm.set_threads(Threads::two_threads()?);
        }
        let listener = Listener::bind(domain, EventName(Role::Learner, 0))?;
        let layout = replay_layout(config);
        let replay = open_replay(&run.replay_file(), &layout)?;
        let mut checkpoints = Checkpoints::new(&run.checkpoints(), layout.fingerprint);
        let counters = restore(&mut checkpoints, &mut *algorithm, &replay)?;

        let mut heartbeat = HeartbeatSender::new(domain, settings.instance)?;
        // After a failure, the launcher compares the policy versions that successive learners begin with.
        heartbeat.set_policy_version(counters.policy_version);
        let mut learner = Self {
            publisher: PolicyPublisher::open(domain, algorithm.policy().len())?,
            evaluator: Notifier::new(domain, EventName(Role::Evaluator, 0))?,
            intake: open_intake(domain, config)?,
            policy_version: counters.policy_version,
            env_steps: counters.rows,
            episodes: counters.episodes,
            reporter: Reporter::open(domain)?,
            losses: LossSums::default(),
            reported_at: Instant::now(),
            sync: None,
            heartbeats: Reports::open(domain)?,
            actors_checked_at: Instant::now(),
            domain,
            settings,
            stop,
            listener,
            replay,
            heartbeat,
            algorithm,
            checkpoints,
        };
        learner.heartbeat.beat(Activity::WaitingForPeer);
        learner.publish_current()?;
        Ok(learner)
    }

    /// Updates so far.
    pub(crate) fn updates(&self) -> u64 {
        self.algorithm.updates()
    }

    /// Makes the next update, on the replay as it was after `self.env_steps` rows.
    pub(crate) fn update(&mut self) -> Result<(), LearnerError> {
        let before = self.updates();
        self.heartbeat.announce_first_step();
        if let Some(losses) = self.algorithm.update(&self.replay, self.env_steps) {
            if !(losses.critic_loss.is_finite() && losses.actor_loss.is_finite()) {
                return Err(LearnerError::Diverged {
                    updates: self.algorithm.updates(),
                });
            }
            self.losses.add(losses);
        }
        self.heartbeat.count(self.updates() - before);
        Ok(())
    }

    /// Sets the environment steps that count for the ratio, and counts the episodes that end within them.
    pub(crate) fn advance_to(&mut self, rows: u64) {
        let newest = self.env_steps.max(self.replay.rows().start)..rows;
        self.episodes += ended_episodes(&self.replay, newest);
        self.env_steps = rows;
    }

    /// Whether all environment steps of the run, or all its episodes, have been collected.
    pub(crate) fn has_all_steps(&self) -> bool {
        self.settings.config.run.has_all_steps(self.env_steps, self.episodes)
    }

    /// Publishes the policy as it is now, as a new version.
    pub(crate) fn publish(&mut self) -> Result<(), LearnerError> {
        self.policy_version += 1;
        self.publish_current()
    }

    fn publish_current(&self) -> Result<(), LearnerError> {
        let header = PolicyHeader {
            incarnation: self.settings.instance.incarnation,
            version: self.policy_version,
            env_steps: self.env_steps,
            updates: self.algorithm.updates(),
            fingerprint: self.algorithm.layout().fingerprint(),
        };
        Ok(self.publisher.publish(&self.algorithm.policy(), header)?)
    }

    /// Opens receivers for new actors: a run can be scaled while it is running.
    pub(crate) fn connect_new_actors(&mut self) -> Result<(), LearnerError> {
        if self.actors_checked_at.elapsed() < NEW_ACTORS_INTERVAL {
            return Ok(());
        }
        self.actors_checked_at = Instant::now();
        while let Some(heartbeat) = self.heartbeats.receive()? {
            let has_own_service = self.settings.config.actors.has_own_service(heartbeat.index);
            if heartbeat.role() == Some(Role::Actor) && has_own_service {
                self.intake.open_receivers(self.domain, heartbeat.index + 1)?;
            }
        }
        Ok(())
    }

    /// Takes the chunks that the actors sent before the end, regardless of the ratio. Only updates without which rows
    /// would be lost are made here. A resumed run makes the others.
    pub(crate) fn take_last_chunks(&mut self) -> Result<(), LearnerError> {
        let begun = Instant::now();
        let mut last_chunk_at = begun;
        while last_chunk_at.elapsed() < QUIET_TIME && begun.elapsed() < LAST_CHUNKS_TIMEOUT {
            let (config, updates) = (&self.settings.config, self.updates());
            let took_any = self.intake.take_in_turn(&mut self.replay, CHUNKS_AT_ONCE, |replay| {
                would_lose_rows(config, replay, updates)
            })?;
            self.advance_to(self.replay.head());
            if would_lose_rows(config, &self.replay, updates) {
                self.update()?;
                last_chunk_at = Instant::now();
            } else if took_any {
                last_chunk_at = Instant::now();
            } else {
                self.listener.wait(Duration::from_millis(10))?;
            }
        }
        Ok(())
    }

    /// Notifies the actors and the evaluator, which may be waiting for a policy.
    pub(crate) fn notify_all(&self) {
        self.intake.notify_all();
        self.evaluator.notify();
    }

    /// Refreshes connections and reports to the launcher what the learner waits for.
    pub(crate) fn refresh_connections(&mut self, activity: Activity) -> Result<(), LearnerError> {
        self.publisher.refresh_connections()?;
        self.report_activity(activity);
        Ok(())
    }

    /// Sends a heartbeat and, if it is time, a report.
    pub(crate) fn report_activity(&mut self, activity: Activity) {
        self.heartbeat.set_policy_version(self.policy_version);
        self.heartbeat.beat(activity);
        if self.reported_at.elapsed() >= REPORT_INTERVAL {
            self.send_report();
        }
    }

    fn send_report(&mut self) {
        self.reported_at = Instant::now();
        let losses = std::mem::take(&mut self.losses);
        let updates = losses.updates.max(1) as f64;
        self.reporter.refresh_connections();
        self.reporter.send(LearnerReport {
            env_steps: self.env_steps,
            episodes: self.episodes,
            updates: self.algorithm.updates(),
            policy_version: self.policy_version,
            critic_loss: losses.critic_loss / updates,
            actor_loss: losses.actor_loss / updates,
            q_mean: losses.q_mean / updates,
            temperature: losses.temperature / updates,
            averaged: losses.updates,
        });
    }

    /// Saves a checkpoint. A free run syncs the replay in the background. A lockstep run flushes it first, because
    /// there a checkpoint is useless without its rows.
    pub(crate) fn save(&mut self) -> Result<(), LearnerError> {
        if self.settings.config.run.mode == Mode::Lockstep {
            self.replay.flush()?;
        } else if self.sync.as_ref().is_none_or(JoinHandle::is_finished) {
            self.end_sync();
            let pending = self.replay.start_sync()?;
            self.sync = match std::thread::Builder::new().name("sync".into()).spawn(|| pending.run()) {
                Ok(thread) => Some(thread),
                // The next checkpoint syncs these rows too.
                Err(cause) => {
                    tracing::warn!("the replay is not synced with this checkpoint: cannot start a thread: {cause}");
                    None
                }
            };
        }
        let counters = Counters {
            updates: self.updates(),
            rows: self.env_steps,
            episodes: self.episodes,
            policy_version: self.policy_version,
        };
        Ok(self.checkpoints.save(&counters, &self.algorithm.state())?)
    }

    fn end_sync(&mut self) {
        match self.sync.take().map(JoinHandle::join) {
            Some(Ok(Ok(synced))) => self.replay.finish_sync(synced),
            Some(Ok(Err(cause))) => tracing::warn!("cannot sync the replay: {cause}"),
            Some(Err(panic)) => std::panic::resume_unwind(panic),
            None => {}
        }
    }

    pub(crate) fn finish(mut self) -> Result<(), LearnerError> {
        self.save()?;
        self.end_sync();
        self.replay.flush()?;
        PolicyFile {
            fingerprint: self.algorithm.layout().fingerprint(),
            version: self.policy_version,
            env_steps: self.env_steps,
            return_mean: f64::NAN,
            return_std: f64::NAN,
            episodes: 0,
            parameters: self.algorithm.policy().into_owned(),
        }
        .write(&self.settings.run.last_policy())?;
        self.send_report();
        self.heartbeat.beat_now(Activity::Done);
        Ok(())
    }
}

/// Opens the run's replay, or creates it if there is none.
fn open_replay(file: &Path, layout: &ReplayLayout) -> Result<Replay, ReplayError> {
    let replay = match Replay::open(file, layout) {
        Err(ReplayError::Missing(_)) => Replay::create(file, layout)?,
        opened => opened?,
    };
    replay.warnings().iter().for_each(|warning| tracing::warn!("{warning}"));
    Ok(replay)
}

/// Restores the algorithm from the newest checkpoint, if there is one. Returns the learner's progress.
fn restore(
    checkpoints: &mut Checkpoints,
    algorithm: &mut dyn Algorithm,
    replay: &Replay,
) -> Result<Counters, LearnerError> {
    let Some(loaded) = checkpoints.load_newest()? else {
        return Ok(Counters::default());
    };
    loaded.warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
    let counters = loaded.checkpoint.counters;
    algorithm.restore(counters.updates, &mut SavedState::from(loaded.checkpoint.arrays))?;
    tracing::info!(
        "continuing after {} updates and {} of {} rows",
        counters.updates,
        counters.rows,
        replay.head()
    );
    if replay.head() < counters.rows {
        tracing::warn!(
            "{} has {} rows, but the checkpoint was made with {}: the missing rows are collected again",
            replay.path().display(),
            replay.head(),
            counters.rows
        );
    }
    Ok(Counters {
        episodes: remaining_episodes(&counters, replay),
        ..counters
    })
}

/// Episodes of the checkpoint that end within the rows that the replay still has. A power loss can take the newest
/// rows. Their replacements are counted when they arrive. If the ring has overwritten some of the run's own rows, the
/// number is estimated.
fn remaining_episodes(counters: &Counters, replay: &Replay) -> u64 {
    let (initial, head) = (initial_rows(replay), replay.head());
    if head >= counters.rows {
        counters.episodes
    } else if replay.rows().start <= initial {
        ended_episodes(replay, initial..head)
    } else {
        let share = (head - initial) as f64 / (counters.rows - initial) as f64;
        (counters.episodes as f64 * share).round() as u64
    }
}

/// Rows that the replay began with. Their episodes are not the run's own.
fn initial_rows(replay: &Replay) -> u64 {
    let actors = 0..replay.layout().actors;
    let own: u64 = actors.map(|actor| replay.committed(actor).rows).sum();
    replay.head().saturating_sub(own)
}

/// The number of episodes that end within `rows`.
fn ended_episodes(replay: &Replay, rows: Range<u64>) -> u64 {
    let layout = replay.layout().row;
    rows.filter(|row| layout.read(replay.row(*row)).last).count() as u64
}

fn open_intake(domain: &Domain, config: &Config) -> Result<Intake, ChannelError> {
    let (actors, chunk) = (&config.actors, config.chunk_layout());
    let mut intake = Intake::open(domain, actors.count, actors.window, chunk, config.run.steps)?;
    if config.actors_that_share() > 0 {
        intake.open_shared_receiver(domain, config.actors_that_share())?;
    }
    Ok(intake)
}

#[cfg(test)]
mod tests {
    use shoal_common::transition::{RowLayout, Transition};

    use super::*;
    use crate::replay::ChunkId;

    /// A replay with this many initial rows, and rows of an actor in episodes of two.
    fn replay(initial: usize, rows: u64, ring: u64) -> (tempfile::TempDir, Replay) {
        let directory = tempfile::tempdir().unwrap();
        let row = RowLayout::new(1, 1);
        let layout = ReplayLayout {
            row,
            ring,
            actors: 1,
            actor_snapshot_words: 0,
            fingerprint: 0,
        };
        let mut replay = Replay::create(&directory.path().join("replay"), &layout).unwrap();
        let numbers = |last| {
            let mut numbers = vec![0.0; row.width()];
            let transition = Transition {
                s: &[0.0],
                a: &[0.0],
                r: 0.0,
                discount: 1.0,
                s_next: &[0.0],
                last,
            };
            row.write(&transition, &mut numbers);
            numbers
        };
        if initial > 0 {
            replay.begin_with_rows(&numbers(true).repeat(initial)).unwrap();
        }
        for sequence in 1..=rows {
            let id = ChunkId {
                incarnation: 0,
                sequence,
            };
            replay.append_and_commit(0, id, &numbers(sequence % 2 == 0)).unwrap();
        }
        (directory, replay)
    }

    #[test]
    fn episodes_that_a_power_loss_took_are_not_counted() {
        let checkpoint = |rows, episodes| Counters {
            rows,
            episodes,
            ..Counters::default()
        };
        let (_directory, whole) = replay(0, 10, 100);
        assert_eq!(remaining_episodes(&checkpoint(8, 4), &whole), 4, "no row is missing");
        assert_eq!(remaining_episodes(&checkpoint(10, 5), &whole), 5);
        assert_eq!(
            remaining_episodes(&checkpoint(15, 7), &whole),
            5,
            "five rows are missing"
        );
        let (_directory, wrapped) = replay(0, 10, 4);
        assert_eq!(remaining_episodes(&checkpoint(20, 9), &wrapped), 5, "estimated");
        let (_directory, with_initial) = replay(6, 10, 100);
        assert_eq!(
            remaining_episodes(&checkpoint(21, 7), &with_initial),
            5,
            "six initial rows"
        );
        let (_directory, wrapped) = replay(6, 10, 8);
        assert_eq!(
            remaining_episodes(&checkpoint(26, 9), &wrapped),
            5,
            "estimated of the actor's rows"
        );
    }
}
