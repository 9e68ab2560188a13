//! Access to a running run from another terminal.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::bail;
use shoal_common::channel::control::{self, Answer, ControlError, Question, RunStatus};
use shoal_common::channel::{ChannelErrorKind, Domain, Sweeper};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

/// How long a launcher may take to answer. One that is starting does not answer at once.
const PATIENCE: Duration = Duration::from_secs(5);

/// How long a run may take to end. Its roles are given less.
const STOP_PATIENCE: Duration = Duration::from_secs(60);

/// A run, and access to its launcher if it has one.
#[derive(Debug)]
pub struct Remote {
    /// The run's directory.
    pub run: RunDir,
    /// The contents of its `config.toml`.
    pub config: Config,
}

impl Remote {
    /// Opens the run in this directory.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let run = RunDir::open(path)?;
        let config = run.config()?;
        Ok(Self { run, config })
    }

    /// Asks the run's launcher; `None` if there is none, or it ends before it answers.
    fn ask(&self, question: Question, patience: Duration) -> anyhow::Result<Option<Answer>> {
        if !self.run.is_running()? {
            return Ok(None);
        }
        let domain = Domain::visit(&self.config.run.id, self.config.actors.max)?;
        let answer = self.ask_in(&domain, question, patience);
        let left = domain.leave();
        let answer = answer?;
        left?;
        Ok(answer)
    }

    fn ask_in(&self, domain: &Domain, question: Question, patience: Duration) -> anyhow::Result<Option<Answer>> {
        let _sweeper = Sweeper::start(domain)?;
        let lives = || self.run.is_running().unwrap_or(true);
        match control::ask(domain, self.run.key()?, question, patience, lives) {
            Ok(Answer::AnotherRun(there)) => {
                let here = self.run.path().display();
                bail!("{here} is a copy of {there}, which is running; the launcher in {here} waits for it to end")
            }
            Ok(answer) => Ok(Some(answer)),
            Err(ControlError::Gone) => Ok(None),
            Err(ControlError::Channel(error)) if error.kind == ChannelErrorKind::Missing => {
                bail!("{}", self.why_missing(domain)?)
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Why there is a launcher that cannot be asked.
    fn why_missing(&self, domain: &Domain) -> anyhow::Result<String> {
        let here = self.run.path().display();
        Ok(if domain.has_members() {
            let directory = domain.directory()?;
            format!(
                "another program has removed files of {here} in {}; its launcher repairs that within seconds, unless it \
                 is stopped",
                directory.display()
            )
        } else {
            format!("{here} is starting or in its final evaluation; ask again later")
        })
    }

    /// The run's status; `None` if it is not running.
    pub fn status(&self) -> anyhow::Result<Option<RunStatus>> {
        match self.ask(Question::Status, PATIENCE)? {
            None => Ok(None),
            Some(Answer::Status(status)) => Ok(Some(status)),
            Some(other) => bail!("the launcher gave an unexpected answer: {other:?}"),
        }
    }

    /// Changes the number of actors.
    pub fn scale(&self, actors: u32) -> anyhow::Result<()> {
        match self.ask(Question::Scale { actors }, PATIENCE)? {
            None => bail!("{}", self.not_running()),
            Some(answer) => accepted(answer),
        }
    }

    /// Ends the run, and waits until it has ended.
    pub fn stop(&self) -> anyhow::Result<()> {
        // A launcher that does not answer at all is noticed sooner this way.
        if self.status()?.is_none() {
            bail!("{}", self.not_running());
        }
        let answer = self.ask(Question::Stop, STOP_PATIENCE)?;
        let asked = Instant::now();
        while self.run.is_running()? {
            if asked.elapsed() >= PATIENCE {
                bail!("{} was told to stop but is still running", self.run.path().display());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        // Without an answer, the run has ended for another reason, which its own terminal reports.
        answer.map_or(Ok(()), accepted)
    }

    fn not_running(&self) -> String {
        let here = self.run.path().display();
        format!("nothing runs in {here}; `shoal resume {here}` continues it")
    }
}

fn accepted(answer: Answer) -> anyhow::Result<()> {
    match answer {
        Answer::Accepted => Ok(()),
        Answer::Refused(reason) => bail!("{reason}"),
        other @ (Answer::Status(_) | Answer::AnotherRun(_)) => {
            bail!("the launcher gave an unexpected answer: {other:?}")
        }
    }
}
