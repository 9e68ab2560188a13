//! The runs in a directory, each with its state from its files and its launcher.

use std::cmp::Ordering;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use serde::Serialize;
use shoal_common::channel::control::RunStatus;
use shoal_common::run_dir::RunDir;
use shoal_run::client::RunClient;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::final_evaluation::FinalEvaluation;
use shoal_run::plan;
use shoal_run::records::outcome::{RunOutcome, RunState};
use shoal_run::records::recorder::read_evaluations;
use shoal_run::status::saved_status;

use crate::launcher::{ALL_ENDED, FAILED};

/// Bytes read from the end of a log; they contain its last line.
const END_OF_LOG: u64 = 1 << 16;

/// The state of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum ListedState {
    /// Its launcher answers.
    Running,
    /// It has a launcher, which does not answer.
    Silent,
    /// All steps, updates and evaluations are done.
    Finished,
    /// It was ended earlier with its state saved; `shoal resume` continues it.
    Stopped,
    /// It ended with an error, which is in `shoal.log`.
    Failed,
    /// Its launcher was killed; `shoal resume` continues it.
    Killed,
    /// It was created but never started.
    New,
    /// Its files cannot be read.
    Damaged,
}

impl ListedState {
    /// The name in `--json`.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Running => "running",
            Self::Silent => "silent",
            Self::Finished => "finished",
            Self::Stopped => "stopped",
            Self::Failed => "failed",
            Self::Killed => "killed",
            Self::New => "new",
            Self::Damaged => "damaged",
        }
    }
}

/// A run in a list.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct ListedRun {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
    pub(crate) state: ListedState,
    /// Why the run has failed, is damaged or silent; or what in `config.toml` differs from what the run was last used
    /// with.
    pub(crate) reason: Option<String>,
    pub(crate) environment: String,
    pub(crate) algorithm: String,
    pub(crate) env_steps: Option<u64>,
    pub(crate) steps: Option<u64>,
    pub(crate) episodes: Option<u64>,
    pub(crate) episodes_limit: Option<u64>,
    /// The highest mean return of its evaluations.
    pub(crate) best_return: Option<f64>,
    /// The mean return of its best policy in the final evaluation.
    pub(crate) final_return: Option<f64>,
}

impl ListedRun {
    /// Reads the run in this directory. A failure becomes its state, so that the other runs are still listed.
    pub(crate) fn new(path: &Path) -> Self {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned());
        let mut listed = Self {
            name: name.unwrap_or_default(),
            path: path.into(),
            state: ListedState::Damaged,
            reason: None,
            environment: String::new(),
            algorithm: String::new(),
            env_steps: None,
            steps: None,
            episodes: None,
            episodes_limit: None,
            best_return: None,
            final_return: None,
        };
        if let Err(error) = listed.read() {
            listed.reason = Some(format!("{error:#}"));
        }
        listed
    }

    fn read(&mut self) -> anyhow::Result<()> {
        let client = RunClient::open(&self.path)?;
        let RunClient { run, config } = &client;
        self.environment.clone_from(&config.environment.name);
        config.algorithm.name().clone_into(&mut self.algorithm);
        (self.steps, self.episodes_limit) = (Some(config.run.steps), config.run.episodes);
        let returns = read_evaluations(&run.evaluations())?
            .into_iter()
            .map(|row| row.return_mean)
            .filter(|mean| mean.is_finite());
        self.best_return = returns.reduce(f64::max);
        match client.status() {
            Ok(Some(status)) => {
                self.state = ListedState::Running;
                self.set_progress(&status);
            }
            Ok(None) => {
                let used = run.config()?;
                let status = saved_status(&used, run)?;
                let failure;
                (self.state, failure) = if status.finished {
                    (ListedState::Finished, None)
                } else {
                    state_after_early_end(run)?
                };
                let evaluation = FinalEvaluation::read(run, status.env_steps)?;
                self.final_return = evaluation.and_then(|it| it.of(SavedPolicy::Best)?.return_mean);
                self.set_progress(&status);
                self.reason = failure.or_else(|| plan::edited(run, &used));
            }
            Err(error) => {
                self.state = ListedState::Silent;
                return Err(error);
            }
        }
        Ok(())
    }

    fn set_progress(&mut self, status: &RunStatus) {
        (self.env_steps, self.episodes) = (Some(status.env_steps), Some(status.episodes));
        (self.steps, self.episodes_limit) = (Some(status.steps), status.episodes_limit);
    }
}

/// The run directories in `directory` by name, with `pendulum-2` before `pendulum-10`.
pub(crate) fn runs_in(directory: &Path) -> io::Result<Vec<PathBuf>> {
    let mut runs = Vec::new();
    for entry in std::fs::read_dir(directory)? {
        let path = entry?.path();
        if path.join("config.toml").is_file() {
            runs.push(path);
        }
    }
    runs.sort_by(|a, b| by_number(&a.to_string_lossy(), &b.to_string_lossy()));
    Ok(runs)
}

/// Orders names; numbers at their end are compared as numbers.
fn by_number(a: &str, b: &str) -> Ordering {
    let parts = |name: &str| {
        let word = name.trim_end_matches(|c: char| c.is_ascii_digit()).to_owned();
        let number = name[word.len()..].parse::<u64>().unwrap_or(0);
        (word, number)
    };
    parts(a).cmp(&parts(b)).then_with(|| a.cmp(b))
}

/// The state of a run that has ended without being finished, and why it failed, if it did.
fn state_after_early_end(run: &RunDir) -> anyhow::Result<(ListedState, Option<String>)> {
    let Some(outcome) = RunOutcome::read(run)? else {
        return Ok((state_from_log(run)?, None));
    };
    Ok(match outcome.state {
        RunState::Stopped => (ListedState::Stopped, None),
        RunState::Failed => (ListedState::Failed, outcome.reason.map(String::from)),
        // `Finished` here: a launcher extended the finished run and was killed before it wrote `Running`.
        RunState::Running | RunState::Finished => (ListedState::Killed, None),
    })
}

/// The state of a run of an earlier version, which wrote no outcome: it follows from the last line of the log.
fn state_from_log(run: &RunDir) -> io::Result<ListedState> {
    let mut file = match File::open(run.log()) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(ListedState::New),
        file => file?,
    };
    let length = file.seek(SeekFrom::End(0))?;
    file.seek(SeekFrom::Start(length.saturating_sub(END_OF_LOG)))?;
    let mut end = Vec::new();
    file.read_to_end(&mut end)?;
    Ok(state_from_last_line(&String::from_utf8_lossy(&end)))
}

fn state_from_last_line(log: &str) -> ListedState {
    // No role writes after its launcher has logged that every role has ended.
    let last = log.lines().next_back().unwrap_or_default();
    match last.strip_prefix("launcher") {
        Some(text) if text.contains(ALL_ENDED) => ListedState::Stopped,
        Some(text) if text.contains(FAILED) => ListedState::Failed,
        _ => ListedState::Killed,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_are_ordered_by_name_and_number() {
        let parent = tempfile::tempdir().unwrap();
        for name in ["pendulum-10", "pendulum-2", "cart-pole-1", "notes"] {
            std::fs::create_dir(parent.path().join(name)).unwrap();
            if name != "notes" {
                std::fs::write(parent.path().join(name).join("config.toml"), "").unwrap();
            }
        }
        let names = runs_in(parent.path()).unwrap();
        let names: Vec<_> = names
            .iter()
            .map(|run| run.file_name().unwrap().to_str().unwrap())
            .collect();
        assert_eq!(names, ["cart-pole-1", "pendulum-2", "pendulum-10"]);
    }

    #[test]
    fn a_failed_run_has_the_reason_of_its_outcome() {
        let parent = tempfile::tempdir().unwrap();
        let run = RunDir::create(&parent.path().join("run")).unwrap();
        let failed = RunOutcome::new(RunState::Failed, 1, 0).with_reason("the disk is full".to_owned());
        failed.write(&run).unwrap();
        let expected = (ListedState::Failed, Some("the disk is full".into()));
        assert_eq!(state_after_early_end(&run).unwrap(), expected);
    }

    #[test]
    fn the_state_follows_from_the_last_line_of_the_log() {
        let start = "launcher       1.0 every role is ready\n";
        let end = format!("{start}launcher       2.0 {ALL_ENDED}\n");
        assert_eq!(state_from_last_line(start), ListedState::Killed);
        assert_eq!(state_from_last_line(&end), ListedState::Stopped);
        assert_eq!(
            state_from_last_line(&format!("{end}launcher       2.1 {FAILED}disk full\n")),
            ListedState::Failed
        );
        assert_eq!(
            state_from_last_line(&format!("{end}learner-0      3.0 started as process 7\n")),
            ListedState::Killed
        );
        assert_eq!(state_from_last_line(""), ListedState::Killed);
    }
}
