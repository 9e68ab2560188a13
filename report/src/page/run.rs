//! The data that the page shows of one run.

use serde::Serialize;
use shoal_common::config::{Config, Mode};
use shoal_common::run_dir::RunDir;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::final_evaluation::{FinalEvaluation, FinalPolicyResult};
use shoal_run::origin::Origin;
use shoal_run::records::outcome::{RunOutcome, RunState};
use shoal_run::records::recorder::{
    ChangeRecord, EpisodeRecord, EvaluationRecord, IncidentRecord, LearnerRecord, read_changes, read_episodes,
    read_evaluations, read_hosts, read_incidents, read_learner,
};
use shoal_run::records::start::StartRecord;

use super::hosts::JoinedHost;
use super::numbers::{PageLimits, downsample, mean, parts, short};
use super::played::Played;
use super::settings::{self, Setting};

/// At most this many incidents of a run are listed.
const MAX_INCIDENTS: usize = 400;

#[derive(Clone, Debug, Serialize)]
pub(super) struct Run {
    /// Unique within the report.
    pub(super) name: String,
    /// The environment's name with its textual parameters, such as the reward.
    pub(super) environment: String,
    pub(super) algorithm: &'static str,
    /// As text: JavaScript's numbers have 53 bits.
    seed: String,
    mode: Mode,
    state: PageState,
    /// Why it ended, if it did not simply finish.
    why: Option<String>,
    pub(super) settings: Vec<Setting>,
    env_steps: u64,
    planned_steps: u64,
    episodes: u64,
    planned_episodes: Option<u64>,
    updates: u64,
    wall_seconds: f64,
    updates_per_step: f64,
    best: Option<EvaluationPoint>,
    last: Option<EvaluationPoint>,
    /// The best policy's final evaluation.
    final_evaluation: Option<FinalPolicyResult>,
    evaluations: Curve,
    exploration: Curve,
    learner: LearnerCurves,
    incidents: Option<Incidents>,
    /// The hosts that have joined.
    hosts: Vec<JoinedHost>,
    /// How, when and where it was started; `None` in runs of earlier versions.
    start: Option<StartRecord>,
    /// What it began with, in words.
    origin: Option<String>,
    /// The changes of its configuration after its start.
    changes: Vec<ChangeRecord>,
    pub(super) played: Played,
    /// Every record, for medians.
    #[serde(skip)]
    pub(super) evaluation_records: Vec<EvaluationRecord>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
enum PageState {
    Training,
    Finished,
    Unfinished,
}

/// An evaluation.
#[derive(Clone, Copy, Debug, Serialize)]
struct EvaluationPoint {
    env_steps: u64,
    mean: f64,
    std: f64,
    episodes: u32,
}

/// Returns over environment steps and time.
#[derive(Clone, Debug, Serialize)]
struct Curve {
    steps: Vec<u64>,
    /// In s.
    time: Vec<f64>,
    mean: Vec<f64>,
    /// Standard deviation over the episodes of one evaluation; empty if the points are not evaluations.
    std: Vec<f64>,
    /// Number of records that the points were selected or averaged from.
    rows: usize,
    /// For the moving mean if the points were selected from more records: for each point, the sum and the number of the
    /// records after the previous point, up to and including this one. Empty if every record is a point, or every point
    /// is a mean of equally many records.
    sums: Vec<f64>,
    counts: Vec<usize>,
}

/// Rates measured over less than this, in s, are not shown.
const MIN_RATE_SPAN: f64 = 0.2;

/// The learner's records, averaged if there are more than the page may contain. NaN where nothing was recorded.
#[derive(Clone, Debug, Serialize)]
struct LearnerCurves {
    steps: Vec<u64>,
    /// Running time, in s.
    time: Vec<f64>,
    ratio: Vec<f64>,
    env_steps_per_second: Vec<f64>,
    updates_per_second: Vec<f64>,
    critic_loss: Vec<f64>,
    actor_loss: Vec<f64>,
    q_mean: Vec<f64>,
    temperature: Vec<f64>,
}

#[derive(Clone, Debug, Serialize)]
struct Incidents {
    rows: Vec<IncidentRecord>,
    /// Number of later incidents that are not listed.
    more: usize,
    restarts: usize,
    kills: usize,
}

impl Run {
    pub(super) fn read(run: &RunDir, name: String, limits: PageLimits) -> anyhow::Result<Self> {
        let config = configuration(run)?;
        // Before the records: if the run ends now, its last records are read below.
        let is_training = run.is_running()?;
        let evaluation_records = read_evaluations(&run.evaluations())?;
        let learner = read_learner(&run.learner_records())?;
        let explored = read_episodes(&run.episodes())?;
        let mut now = learner.last().cloned().unwrap_or_default();
        let outcome = RunOutcome::read(run)?;
        if let Some(outcome) = &outcome {
            // The learner's last report may have been lost.
            now.env_steps = now.env_steps.max(outcome.steps);
            now.episodes = now.episodes.max(outcome.episodes);
        }
        let all_steps = config.run.has_all_steps(now.env_steps, now.episodes);
        let outcome_allows = outcome
            .as_ref()
            .is_none_or(|outcome| outcome.state == RunState::Finished);
        let is_finished = all_steps && outcome_allows;
        Ok(Self {
            name,
            environment: environment_label(&config),
            algorithm: config.algorithm.name(),
            seed: config.run.seed.to_string(),
            mode: config.run.mode,
            state: match (is_training, is_finished) {
                (true, _) => PageState::Training,
                (false, true) => PageState::Finished,
                (false, false) => PageState::Unfinished,
            },
            why: outcome.filter(|_| !is_training).and_then(reason),
            settings: settings::of(&config)?,
            env_steps: now.env_steps,
            planned_steps: config.run.steps,
            // Older versions did not record the count in learner.csv, only the episodes themselves.
            episodes: now.episodes.max(explored.len() as u64),
            planned_episodes: config.run.episodes,
            updates: now.updates,
            wall_seconds: short(now.wall_seconds),
            updates_per_step: config.replay.updates_per_step,
            best: evaluation_records
                .iter()
                .rev()
                .find(|row| row.best == 1)
                .map(EvaluationPoint::of),
            last: evaluation_records.last().map(EvaluationPoint::of),
            final_evaluation: FinalEvaluation::read(run, now.env_steps)?
                .and_then(|it| it.of(SavedPolicy::Best).cloned()),
            evaluations: Curve::of_evaluations(&evaluation_records, limits.points),
            exploration: Curve::of_episodes(&explored, limits.points),
            learner: LearnerCurves::of(learner, limits.points),
            incidents: read_incidents(&run.incidents())?.map(Incidents::of),
            hosts: JoinedHost::all(&read_hosts(&run.hosts())?),
            start: StartRecord::read(run.path())?,
            origin: Origin::read(run)?.map(|origin| origin.in_words()),
            changes: read_changes(&run.changes())?,
            played: Played::of(run, &config, limits),
            evaluation_records,
        })
    }
}

impl Run {
    /// The run's result, and whether it has finished: the mean return of its final evaluation, or of its last
    /// evaluation if there is none.
    pub(super) fn result(&self) -> Option<(f64, bool)> {
        let finally = self.final_evaluation.as_ref().and_then(|it| it.return_mean);
        let last = || self.evaluation_records.last().map(|row| row.return_mean);
        let mean = finally.or_else(last).filter(|mean| mean.is_finite())?;
        Some((mean, self.state == PageState::Finished))
    }
}

impl EvaluationPoint {
    fn of(row: &EvaluationRecord) -> Self {
        Self {
            env_steps: row.env_steps,
            mean: short(row.return_mean),
            std: short(row.return_std),
            episodes: row.episodes,
        }
    }
}

impl Curve {
    fn of_evaluations(rows: &[EvaluationRecord], points: usize) -> Self {
        let means: Vec<f64> = rows.iter().map(|row| row.return_mean).collect();
        let indices = downsample(&means, points);
        let (mut sums, mut counts) = (Vec::new(), Vec::new());
        if indices.len() < rows.len() {
            let mut from = 0;
            for i in &indices {
                let since = means[from..=*i].iter().copied().filter(|mean| mean.is_finite());
                counts.push(since.clone().count());
                sums.push(short(since.sum()));
                from = i + 1;
            }
        }
        let shown: Vec<&EvaluationRecord> = indices.into_iter().map(|i| &rows[i]).collect();
        Self {
            sums,
            counts,
            steps: shown.iter().map(|row| row.env_steps).collect(),
            time: shown.iter().map(|row| short(row.wall_seconds)).collect(),
            mean: shown.iter().map(|row| short(row.return_mean)).collect(),
            std: shown.iter().map(|row| short(row.return_std)).collect(),
            rows: rows.len(),
        }
    }

    /// Means over consecutive episodes.
    fn of_episodes(rows: &[EpisodeRecord], points: usize) -> Self {
        let shown: Vec<&[EpisodeRecord]> = parts(rows.len(), points).map(|part| &rows[part]).collect();
        let last = |part: &&[EpisodeRecord]| part.last().cloned().unwrap_or_default();
        Self {
            steps: shown.iter().map(|part| last(part).env_steps).collect(),
            time: shown.iter().map(|part| short(last(part).wall_seconds)).collect(),
            mean: shown
                .iter()
                .map(|part| mean(part.iter().map(|row| row.episode_return)))
                .collect(),
            std: Vec::new(),
            rows: rows.len(),
            sums: Vec::new(),
            counts: Vec::new(),
        }
    }
}

impl LearnerCurves {
    fn of(mut rows: Vec<LearnerRecord>, points: usize) -> Self {
        let is_too_short = |i: &usize| rows[*i].wall_seconds - rows[i - 1].wall_seconds < MIN_RATE_SPAN;
        let too_short: Vec<usize> = (1..rows.len()).filter(is_too_short).collect();
        for i in too_short {
            (rows[i].env_steps_per_second, rows[i].updates_per_second) = (None, None);
        }
        if last_is_incomplete(&rows)
            && let Some(last) = rows.last_mut()
        {
            (last.env_steps_per_second, last.updates_per_second) = (None, None);
        }
        let shown: Vec<&[LearnerRecord]> = parts(rows.len(), points).map(|part| &rows[part]).collect();
        let last = |part: &&[LearnerRecord]| part.last().cloned().unwrap_or_default();
        let column = |of: fn(&LearnerRecord) -> Option<f64>| -> Vec<f64> {
            shown.iter().map(|part| mean(part.iter().filter_map(of))).collect()
        };
        Self {
            steps: shown.iter().map(|part| last(part).env_steps).collect(),
            time: shown.iter().map(|part| short(last(part).wall_seconds)).collect(),
            ratio: column(|row| row.ratio),
            env_steps_per_second: column(|row| row.env_steps_per_second),
            updates_per_second: column(|row| row.updates_per_second),
            critic_loss: column(|row| row.critic_loss),
            actor_loss: column(|row| row.actor_loss),
            q_mean: column(|row| row.q_mean),
            temperature: column(|row| row.temperature),
        }
    }
}

/// Why a run ended, in words.
fn reason(RunOutcome { state, reason, .. }: RunOutcome) -> Option<String> {
    let reason = reason?;
    match state {
        // Its launcher was killed: the reason only says what it was doing.
        RunState::Running => None,
        RunState::Finished => Some(reason.to_string()),
        RunState::Stopped => Some(format!("stopped ({reason})")),
        RunState::Failed => Some(format!("failed: {reason}")),
    }
}

/// Whether the last row came sooner after the one before than usual, because the run ended. Its rates would mislead.
fn last_is_incomplete(rows: &[LearnerRecord]) -> bool {
    let mut spans: Vec<f64> = rows
        .windows(2)
        .map(|pair| pair[1].wall_seconds - pair[0].wall_seconds)
        .collect();
    let Some(last) = spans.pop() else { return false };
    spans.sort_by(f64::total_cmp);
    spans.get(spans.len() / 2).is_some_and(|usual| last < 0.9 * usual)
}

impl Incidents {
    fn of(mut rows: Vec<IncidentRecord>) -> Self {
        use shoal_run::records::recorder::IncidentKind;
        let count = |what| rows.iter().filter(|row| row.what == what).count();
        let (restarts, kills) = (count(IncidentKind::Restarted), count(IncidentKind::Killed));
        let more = rows.len().saturating_sub(MAX_INCIDENTS);
        rows.truncate(MAX_INCIDENTS);
        Self {
            rows,
            more,
            restarts,
            kills,
        }
    }
}

/// The run's configuration. An error names the file, so that it is clear which of several runs is meant.
fn configuration(run: &RunDir) -> anyhow::Result<Config> {
    let path = run.config_file().display().to_string();
    run.config().map_err(|error| match error.to_string() {
        message if message.contains(&path) => error.into(),
        message => anyhow::anyhow!("{path}: {message}"),
    })
}

/// The environment's name and its textual parameters: returns of different rewards cannot be compared.
fn environment_label(config: &Config) -> String {
    let environment = &config.environment;
    let words = environment.parameters.values().filter_map(toml::Value::as_str);
    [environment.name.as_str()]
        .into_iter()
        .chain(words)
        .collect::<Vec<_>>()
        .join(" ")
}

/// A name for each run: the name of its directory, with the parent directory if two runs have the same name.
pub(super) fn names(runs: &[RunDir]) -> Vec<String> {
    let short: Vec<String> = runs.iter().map(RunDir::name).collect();
    let name = |(run, name): (&RunDir, &String)| {
        let alike = short.iter().filter(|other| *other == name).count() > 1;
        let above = run.path().parent().filter(|_| alike);
        match above.and_then(|above| above.file_name()) {
            Some(above) => format!("{}/{name}", above.to_string_lossy()),
            None => name.clone(),
        }
    };
    runs.iter().zip(&short).map(name).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rates_of_an_incomplete_last_window_are_left_out() {
        let rates = |last: f64| {
            let times = [0.5, 1.0, 1.5, 2.0, last];
            let row = |wall_seconds: f64| {
                let mut row = LearnerRecord::default();
                (row.wall_seconds, row.ratio) = (wall_seconds, Some(1.0));
                (row.env_steps_per_second, row.updates_per_second) = (Some(500.0), Some(500.0));
                row
            };
            LearnerCurves::of(times.map(row).into(), 10)
        };
        let complete = rates(2.5);
        assert_eq!(
            (complete.env_steps_per_second[4], complete.updates_per_second[4]),
            (500.0, 500.0)
        );
        let incomplete = rates(2.3);
        assert!(incomplete.env_steps_per_second[4].is_nan() && incomplete.updates_per_second[4].is_nan());
        assert_eq!((incomplete.env_steps_per_second[3], incomplete.ratio[4]), (500.0, 1.0));
    }
}
