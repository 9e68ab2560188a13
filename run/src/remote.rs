//! A run that goes on, seen from another terminal.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::bail;
use shoal_common::channel::control::{self, Answer, ControlError, Question, RunStatus};
use shoal_common::channel::{Domain, Sweeper};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

/// How long a launcher may take to answer: one that starts does not at once.
const PATIENCE: Duration = Duration::from_secs(5);

/// How long a run may take to end: more than its roles are given.
const TO_THE_END: Duration = Duration::from_secs(60);

/// A run and the way to its launcher, if it has one.
#[derive(Debug)]
pub struct Remote {
    /// The run's directory.
    pub run: RunDir,
    /// What is in its `config.toml`.
    pub config: Config,
}

impl Remote {
    /// The run in this directory.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let run = RunDir::open(path)?;
        let config = run.config()?;
        Ok(Self { run, config })
    }

    /// Asks the run's launcher; `None` where there is none, or none any more.
    fn ask(&self, question: Question, patience: Duration) -> anyhow::Result<Option<Answer>> {
        if !self.run.goes_on()? {
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
        let lives = || self.run.goes_on().unwrap_or(true);
        match control::ask(domain, self.run.key()?, question, patience, lives) {
            Ok(Answer::AnotherRun(there)) => {
                let here = self.run.path().display();
                bail!("{here} is a copy of {there}, which is going on; what was started here waits for that one to end")
            }
            Ok(answer) => Ok(Some(answer)),
            Err(ControlError::Gone) => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// How the run gets on; `None` where it does not go on.
    pub fn status(&self) -> anyhow::Result<Option<RunStatus>> {
        match self.ask(Question::Status, PATIENCE)? {
            None => Ok(None),
            Some(Answer::Status(status)) => Ok(Some(status)),
            Some(other) => bail!("the launcher gave an answer that does not fit: {other:?}"),
        }
    }

    /// Goes on with so many actors.
    pub fn scale(&self, actors: u32) -> anyhow::Result<()> {
        match self.ask(Question::Scale { actors }, PATIENCE)? {
            None => bail!("{}", self.nothing_runs()),
            Some(answer) => self.accepted(answer),
        }
    }

    /// Ends the run, and waits until it has ended.
    pub fn stop(&self) -> anyhow::Result<()> {
        // A launcher that does not answer at all is not waited for so long.
        if self.status()?.is_none() {
            bail!("{}", self.nothing_runs());
        }
        let answer = self.ask(Question::Stop, TO_THE_END)?;
        let asked = Instant::now();
        while self.run.goes_on()? {
            if asked.elapsed() >= PATIENCE {
                bail!("{} has said that it ends, and does not", self.run.path().display());
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        // Without an answer it has ended for another reason, which its own terminal says.
        answer.map_or(Ok(()), |answer| self.accepted(answer))
    }

    fn accepted(&self, answer: Answer) -> anyhow::Result<()> {
        match answer {
            Answer::Accepted => Ok(()),
            Answer::Refused(reason) => bail!("{reason}"),
            other @ (Answer::Status(_) | Answer::AnotherRun(_)) => {
                bail!("the launcher gave an answer that does not fit: {other:?}")
            }
        }
    }

    fn nothing_runs(&self) -> String {
        let here = self.run.path().display();
        format!("nothing runs in {here}; `shoal resume {here}` goes on with it")
    }
}
