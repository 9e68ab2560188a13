//! The run's records: six tables, three of them also as TensorBoard scalars.

mod change;
mod host;
mod incident;
mod table;
mod tensorboard;

use std::path::Path;
use std::time::{Duration, Instant};

pub use change::{ChangeRecord, Moment, read_changes, record_changes};
use host::HostTable;
pub use host::{HostRecord, RecordedHostState, read_hosts};
pub use incident::{Incident, IncidentKind, IncidentRecord};
use serde::{Deserialize, Serialize};
use shoal_common::channel::control::HostStatus;
use shoal_common::config::{Config, ReplayConfig};
use shoal_common::report::{EpisodeReport, EvaluationReport, LearnerReport};
use shoal_common::run_dir::RunDir;
pub use table::RecordError;
use table::Table;

use self::tensorboard::EventFile;
use crate::evaluation::SavedPolicy;
use crate::evaluation::final_evaluation::FinalEvaluation;
use crate::records::rate::per_second;

/// The longest time that rows stay unflushed. A `kill -9` of the launcher loses at most these.
const MAX_UNFLUSHED: Duration = Duration::from_millis(500);

/// A row of `episodes.csv`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeRecord {
    /// Running time of the run so far in seconds, over all its launchers.
    pub wall_seconds: f64,
    /// Environment steps of all actors so far.
    pub env_steps: u64,
    actor: u32,
    environment: u32,
    /// Steps of the episode.
    pub steps: u32,
    /// 1 if the environment terminated the episode, 0 if the time limit truncated it.
    pub terminated: u32,
    /// Sum of the episode's rewards.
    #[serde(rename = "return")]
    pub episode_return: f64,
    /// Version of the policy at the end of the episode.
    pub policy_version: u64,
}

/// A row of `evaluations.csv`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EvaluationRecord {
    /// Running time of the run so far in seconds, over all its launchers.
    pub wall_seconds: f64,
    /// Environment steps the policy was learned from.
    pub env_steps: u64,
    /// Updates that made the policy.
    pub updates: u64,
    /// Version of the policy.
    pub policy_version: u64,
    /// Mean of the episodes' returns.
    pub return_mean: f64,
    /// Standard deviation of the episodes' returns (n − 1).
    pub return_std: f64,
    /// Number of episodes.
    pub episodes: u32,
    /// 1 if this policy became the best one.
    pub best: u32,
}

/// A row of `learner.csv`. A value is empty if it is undefined: a loss without an update since the previous row, or a
/// rate without a previous row.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LearnerRecord {
    /// Running time of the run so far in seconds, over all its launchers.
    pub wall_seconds: f64,
    /// Environment steps committed to the replay.
    pub env_steps: u64,
    /// Episodes ended; 0 in the records of earlier versions.
    #[serde(default)]
    pub episodes: u64,
    /// Updates so far.
    pub updates: u64,
    policy_version: u64,
    /// Mean loss of the value estimate since the previous row.
    pub critic_loss: Option<f64>,
    /// Mean loss of the policy since the previous row.
    pub actor_loss: Option<f64>,
    /// Mean of the estimated values since the previous row.
    pub q_mean: Option<f64>,
    /// Since the previous row.
    pub updates_per_second: Option<f64>,
    /// Since the previous row.
    pub env_steps_per_second: Option<f64>,
    /// Updates per environment step after the warm-up.
    pub ratio: Option<f64>,
    /// Mean temperature α since the previous row; `None` for algorithms without one and in records of earlier versions.
    #[serde(default)]
    pub temperature: Option<f64>,
}

/// Writes the records of a run. Continues those of a resumed run: one header, and seconds that keep counting.
#[derive(Debug)]
pub struct Recorder {
    episodes: Table,
    evaluations: Table,
    learner: Table,
    incidents: Table,
    hosts: HostTable,
    events: EventFile,
    events_path: std::path::PathBuf,
    replay: ReplayConfig,
    /// Running time of earlier launchers in seconds.
    earlier_seconds: f64,
    /// Environment steps of the last row of `learner.csv`.
    env_steps: u64,
    /// Environment steps of the last row of `episodes.csv`.
    episode_steps: u64,
    /// Environment steps of the newest policy whose evaluation is recorded.
    evaluated: Option<u64>,
    previous: Option<(Duration, LearnerReport)>,
    flushed_at: Instant,
}

/// Records the final evaluation of a run with `env_steps` environment steps for TensorBoard, as scalars named
/// `final/…`.
///
/// # Errors
/// When the evaluation cannot be read, or the record cannot be written.
pub fn record_final(run: &RunDir, env_steps: u64) -> anyhow::Result<()> {
    let Some(evaluation) = FinalEvaluation::read(run, env_steps)? else {
        return Ok(());
    };
    let write = || {
        let mut events = EventFile::create(&run.tensorboard(), None)?;
        for policy in &evaluation.policies {
            let name = match policy.policy {
                SavedPolicy::Best => "best",
                SavedPolicy::Last => "last",
            };
            let [mean, std] = ["mean", "std"].map(|which| format!("final/{name}_return_{which}"));
            let scalars = [(&*mean, policy.return_mean), (&*std, policy.return_std)];
            let scalars = scalars.map(|(tag, value)| (tag, value.unwrap_or(f64::NAN)));
            events.scalars(evaluation.env_steps, &scalars)?;
        }
        events.finished()?;
        events.flush()
    };
    let path = run.tensorboard();
    Ok(write().map_err(|cause| RecordError::Write { path, cause })?)
}

impl Recorder {
    /// Opens the records of `run`, whose ratio of updates to environment steps is that of `replay`.
    pub fn open(run: &RunDir, replay: &ReplayConfig) -> Result<Self, RecordError> {
        let episodes = Table::open::<EpisodeRecord>(&run.episodes())?;
        let evaluations = Table::open::<EvaluationRecord>(&run.evaluations())?;
        let learner = Table::open::<LearnerRecord>(&run.learner_records())?;
        let incidents = Table::open::<IncidentRecord>(&run.incidents())?;
        change::create(run)?;
        let evaluated = read_evaluations(&run.evaluations())?
            .iter()
            .map(|row| row.env_steps)
            .max();
        let learned = read_learner(&run.learner_records())?;
        let earlier_seconds = learned.last().map_or(0.0, |row| row.wall_seconds);
        // Not the last rows: in records of earlier versions the steps may have fallen.
        let env_steps = learned.iter().map(|row| row.env_steps).max().unwrap_or(0);
        let mut episode_steps = 0;
        table::for_each_row(&run.episodes(), |row: EpisodeRecord| {
            episode_steps = episode_steps.max(row.env_steps);
        })?;
        let newest = env_steps.max(episode_steps).max(evaluated.unwrap_or(0));
        let first_step = (!learned.is_empty()).then_some(newest.saturating_add(1));
        let events = EventFile::create(&run.tensorboard(), first_step).map_err(|cause| RecordError::Write {
            path: run.tensorboard(),
            cause,
        })?;
        let (events_path, flushed) = (run.tensorboard(), Instant::now());
        let mut recorder = Self {
            episodes,
            evaluations,
            learner,
            incidents,
            hosts: HostTable::new(run.hosts()),
            events,
            events_path,
            replay: replay.clone(),
            earlier_seconds,
            env_steps,
            episode_steps,
            evaluated,
            previous: None,
            flushed_at: flushed,
        };
        if first_step.is_some() {
            let resumed = Incident::of_launcher(IncidentKind::Resumed, String::new());
            recorder.incident(&resumed, Duration::ZERO)?;
        }
        Ok(recorder)
    }

    /// Records the settings for TensorBoard.
    pub fn settings(&mut self, config: &Config) -> Result<(), RecordError> {
        let mut settings = config.values();
        // The program chooses the run's id, and the environment its spaces.
        settings.retain(|key, _| key != "run.id" && !key.starts_with("spec."));
        let written = self.events.hyperparameters(&settings);
        written.map_err(|cause| RecordError::Write {
            path: self.events_path.clone(),
            cause,
        })
    }

    /// Records an exploration episode that ended `wall` after this launcher's start. Its steps are those of all actors
    /// by then. They never fall, even if reports arrive out of order or a replay has lost rows.
    pub fn episode(&mut self, report: &EpisodeReport, wall: Duration) -> Result<(), RecordError> {
        self.episode_steps = self.episode_steps.max(report.env_steps);
        self.episodes.write(&EpisodeRecord {
            wall_seconds: self.seconds(wall),
            env_steps: self.episode_steps,
            actor: report.actor,
            environment: report.environment,
            steps: report.steps,
            terminated: report.terminated,
            episode_return: report.episode_return,
            policy_version: report.policy_version,
        })?;
        let scalars = [
            ("episode/return", report.episode_return),
            ("episode/steps", report.steps.into()),
        ];
        self.scalars(self.episode_steps, &scalars)?;
        if self.flushed_at.elapsed() >= MAX_UNFLUSHED {
            self.flush()
        } else {
            Ok(())
        }
    }

    /// Environment steps of the newest policy whose evaluation is recorded.
    pub fn evaluated(&self) -> Option<u64> {
        self.evaluated
    }

    /// Records an evaluation. Skips those already recorded, which a restarted evaluator reports again.
    pub fn evaluation(&mut self, report: &EvaluationReport, wall: Duration) -> Result<(), RecordError> {
        if self.evaluated >= Some(report.env_steps) {
            return Ok(());
        }
        self.evaluated = Some(report.env_steps);
        self.evaluations.write(&EvaluationRecord {
            wall_seconds: self.seconds(wall),
            env_steps: report.env_steps,
            updates: report.updates,
            policy_version: report.policy_version,
            return_mean: report.return_mean,
            return_std: report.return_std,
            episodes: report.episodes,
            best: report.best,
        })?;
        let scalars = [
            ("evaluation/return_mean", report.return_mean),
            ("evaluation/return_std", report.return_std),
        ];
        self.scalars(report.env_steps, &scalars)?;
        self.flush()
    }

    /// Records the learner's progress and flushes all records. Reports come twice a second. A learner that continues
    /// from an older checkpoint repeats steps: they are not recorded again.
    pub fn learner(&mut self, report: &LearnerReport, wall: Duration) -> Result<(), RecordError> {
        if report.env_steps < self.env_steps {
            return self.flush();
        }
        let averaged = |mean: f64| (report.averaged > 0).then_some(mean);
        let rate = |count: fn(&LearnerReport) -> u64| {
            let (before, previous) = self.previous.as_ref()?;
            per_second((*before, count(previous)), (wall, count(report)))
        };
        let row = LearnerRecord {
            wall_seconds: self.seconds(wall),
            env_steps: report.env_steps,
            episodes: report.episodes,
            updates: report.updates,
            policy_version: report.policy_version,
            critic_loss: averaged(report.critic_loss),
            actor_loss: averaged(report.actor_loss),
            q_mean: averaged(report.q_mean),
            updates_per_second: rate(|report| report.updates),
            env_steps_per_second: rate(|report| report.env_steps),
            ratio: self.replay.ratio(report.updates, report.env_steps),
            temperature: averaged(report.temperature).filter(|temperature| temperature.is_finite()),
        };
        self.env_steps = report.env_steps;
        self.previous = Some((wall, *report));
        self.learner.write(&row)?;
        let scalars = [
            ("learner/critic_loss", row.critic_loss),
            ("learner/actor_loss", row.actor_loss),
            ("learner/q_mean", row.q_mean),
            ("learner/updates_per_second", row.updates_per_second),
            ("learner/env_steps_per_second", row.env_steps_per_second),
            ("learner/ratio", row.ratio),
            ("learner/temperature", row.temperature),
        ];
        self.scalars(
            report.env_steps,
            &scalars.map(|(tag, value)| (tag, value.unwrap_or(f64::NAN))),
        )?;
        self.flush()
    }

    /// Records an incident. It is in the file when this returns.
    pub fn incident(&mut self, incident: &Incident, wall: Duration) -> Result<(), RecordError> {
        self.incidents.write(&IncidentRecord {
            wall_seconds: self.seconds(wall),
            env_steps: self.env_steps,
            role: incident.role.into(),
            index: incident.index,
            what: incident.what,
            detail: incident.detail.clone(),
        })?;
        self.incidents.flush()
    }

    /// Records the other hosts as they are `wall` after this launcher's start. It may be called at any rate; each host
    /// is recorded when its state changes, and every few seconds.
    pub fn hosts(&mut self, hosts: &[HostStatus], wall: Duration) -> Result<(), RecordError> {
        let moment = self.moment(wall);
        self.hosts.record(hosts, wall, moment)
    }

    /// Writes everything to the files, so that it survives the death of this process.
    pub fn flush(&mut self) -> Result<(), RecordError> {
        self.flushed_at = Instant::now();
        for table in [&mut self.episodes, &mut self.evaluations, &mut self.learner] {
            table.flush()?;
        }
        self.events.flush().map_err(|cause| RecordError::Write {
            path: self.events_path.clone(),
            cause,
        })
    }

    fn scalars(&mut self, env_steps: u64, scalars: &[(&str, f64)]) -> Result<(), RecordError> {
        let path = &self.events_path;
        self.events
            .scalars(env_steps, scalars)
            .map_err(|cause| RecordError::Write {
                path: path.clone(),
                cause,
            })
    }

    /// The moment `wall` after this launcher's start.
    pub fn moment(&self, wall: Duration) -> Moment {
        Moment {
            wall_seconds: self.seconds(wall),
            env_steps: self.env_steps,
        }
    }

    /// Running time of the run so far in seconds, rounded to milliseconds.
    fn seconds(&self, wall: Duration) -> f64 {
        ((self.earlier_seconds + wall.as_secs_f64()) * 1e3).round() / 1e3
    }
}

/// The rows of an `evaluations.csv`; empty if there is no such file.
pub fn read_evaluations(path: &Path) -> Result<Vec<EvaluationRecord>, RecordError> {
    table::rows(path)
}

/// The rows of an `episodes.csv`; empty if there is no such file.
pub fn read_episodes(path: &Path) -> Result<Vec<EpisodeRecord>, RecordError> {
    table::rows(path)
}

/// The rows of a `learner.csv`; empty if there is no such file.
pub fn read_learner(path: &Path) -> Result<Vec<LearnerRecord>, RecordError> {
    table::rows(path)
}

/// The rows of an `incidents.csv`; `None` if there is no such file, as in runs of earlier versions.
pub fn read_incidents(path: &Path) -> Result<Option<Vec<IncidentRecord>>, RecordError> {
    let is_missing = matches!(path.try_exists(), Ok(false));
    (!is_missing).then(|| table::rows(path)).transpose()
}

/// Environment steps and episodes of a run, by the last row of its `learner.csv`; `None` before the first row.
pub fn recorded(run: &RunDir) -> Result<Option<(u64, u64)>, RecordError> {
    Ok(table::last::<LearnerRecord>(&run.learner_records())?.map(|row| (row.env_steps, row.episodes)))
}

#[cfg(test)]
mod tests;
