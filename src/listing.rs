//! The runs in a directory, each with its state as far as its files and its launcher tell.

use std::cmp::Ordering;
use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use serde::Serialize;
use shoal_common::channel::control::RunStatus;
use shoal_common::run_dir::RunDir;
use shoal_run::evaluation::WhichPolicy;
use shoal_run::final_evaluation::FinalEvaluation;
use shoal_run::outcome::{RunOutcome, RunState};
use shoal_run::recorder::read_evaluations;
use shoal_run::remote::Remote;
use shoal_run::status::at_rest;

use crate::launcher::{EVERYBODY_ENDED, FAILED};

/// Bytes at the end of a log that its last launcher's last line lies in.
const END_OF_LOG: u64 = 1 << 16;

/// How a run stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum ListedState {
    /// A launcher works on it.
    Running,
    /// A launcher works on it and does not answer.
    Silent,
    /// All its steps are taken.
    Finished,
    /// Ended in order before that; `shoal resume` goes on.
    Stopped,
    /// Ended by an error, which `shoal.log` tells.
    Failed,
    /// Its launcher was killed; `shoal resume` goes on.
    Killed,
    /// Made, and never begun.
    New,
    /// Its files cannot be read.
    Damaged,
}

impl ListedState {
    /// As it is written in `--json`.
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
pub(crate) struct Listed {
    pub(crate) name: String,
    pub(crate) path: PathBuf,
    pub(crate) state: ListedState,
    /// Why it is damaged or silent.
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

impl Listed {
    /// The run in this directory. Whatever is wrong with it is its state, not an error: the others are to be seen too.
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
        if let Err(error) = listed.look() {
            listed.reason = Some(format!("{error:#}"));
        }
        listed
    }

    fn look(&mut self) -> anyhow::Result<()> {
        let remote = Remote::open(&self.path)?;
        let Remote { run, config } = &remote;
        self.environment.clone_from(&config.environment.name);
        config.algorithm.name().clone_into(&mut self.algorithm);
        (self.steps, self.episodes_limit) = (Some(config.run.steps), config.run.episodes);
        let returns = read_evaluations(&run.evaluations())?
            .into_iter()
            .map(|row| row.return_mean);
        self.best_return = returns.reduce(f64::max);
        match remote.status() {
            Ok(Some(status)) => {
                self.state = ListedState::Running;
                self.reached(&status);
            }
            Ok(None) => {
                let status = at_rest(&run.config()?, run)?;
                self.state = if status.finished {
                    ListedState::Finished
                } else {
                    ended(run)?
                };
                let evaluation = FinalEvaluation::read(run, status.env_steps)?;
                self.final_return = evaluation.and_then(|it| it.of(WhichPolicy::Best)?.return_mean);
                self.reached(&status);
            }
            Err(error) => {
                self.state = ListedState::Silent;
                return Err(error);
            }
        }
        Ok(())
    }

    fn reached(&mut self, status: &RunStatus) {
        (self.env_steps, self.episodes) = (Some(status.env_steps), Some(status.episodes));
        (self.steps, self.episodes_limit) = (Some(status.steps), status.episodes_limit);
    }
}

/// The run directories in `directory`, by name, `pendulum-2` before `pendulum-10`.
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

/// Numbers at the end of a name are compared as numbers.
fn by_number(a: &str, b: &str) -> Ordering {
    let parts = |name: &str| {
        let word = name.trim_end_matches(|c: char| c.is_ascii_digit()).to_owned();
        let number = name[word.len()..].parse::<u64>().unwrap_or(0);
        (word, number)
    };
    parts(a).cmp(&parts(b)).then_with(|| a.cmp(b))
}

/// How a run ended that has not reached its end.
fn ended(run: &RunDir) -> anyhow::Result<ListedState> {
    Ok(match RunOutcome::read(run)?.map(|outcome| outcome.state) {
        None => ended_by_its_log(run)?,
        Some(RunState::Stopped) => ListedState::Stopped,
        Some(RunState::Failed) => ListedState::Failed,
        // Finished, and given more steps since, by a launcher that was killed before it said that it runs.
        Some(RunState::Running | RunState::Finished) => ListedState::Killed,
    })
}

/// The same of a run of a build that wrote no outcome: what its launcher logged last.
fn ended_by_its_log(run: &RunDir) -> io::Result<ListedState> {
    let mut file = match File::open(run.log()) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(ListedState::New),
        file => file?,
    };
    let length = file.seek(SeekFrom::End(0))?;
    file.seek(SeekFrom::Start(length.saturating_sub(END_OF_LOG)))?;
    let mut end = Vec::new();
    file.read_to_end(&mut end)?;
    Ok(last_words(&String::from_utf8_lossy(&end)))
}

fn last_words(log: &str) -> ListedState {
    // Whatever a role says comes before its launcher says that all have ended.
    let last = log.lines().next_back().unwrap_or_default();
    match last.strip_prefix("launcher") {
        Some(words) if words.contains(EVERYBODY_ENDED) => ListedState::Stopped,
        Some(words) if words.contains(FAILED) => ListedState::Failed,
        _ => ListedState::Killed,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_come_in_the_order_of_their_numbers() {
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
    fn the_last_line_of_the_log_tells_how_a_run_ended() {
        let start = "launcher       1.0 every role is ready\n";
        let end = format!("{start}launcher       2.0 {EVERYBODY_ENDED}\n");
        assert_eq!(last_words(start), ListedState::Killed);
        assert_eq!(last_words(&end), ListedState::Stopped);
        assert_eq!(
            last_words(&format!("{end}launcher       2.1 {FAILED}disk full\n")),
            ListedState::Failed
        );
        assert_eq!(
            last_words(&format!("{end}learner-0      3.0 started as process 7\n")),
            ListedState::Killed
        );
        assert_eq!(last_words(""), ListedState::Killed);
    }
}
