//! A run that goes on, seen from another terminal.

use std::path::Path;
use std::time::Duration;

use anyhow::bail;
use shoal_common::channel::Domain;
use shoal_common::channel::control::{self, Answer, ControlError, Question, RunStatus};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

/// A launcher that starts, or ends, does not answer for a while.
const PATIENCE: Duration = Duration::from_secs(5);

/// A run and the way to its launcher, if it has one.
#[derive(Debug)]
pub(crate) struct Remote {
    pub(crate) run: RunDir,
    pub(crate) config: Config,
}

impl Remote {
    /// The run in this directory.
    pub(crate) fn open(path: &Path) -> anyhow::Result<Self> {
        let run = RunDir::open(path)?;
        let config = run.config()?;
        Ok(Self { run, config })
    }

    /// Asks the run's launcher; `None` where there is none, or none any more.
    fn ask(&self, question: Question) -> anyhow::Result<Option<Answer>> {
        if !self.run.goes_on()? {
            return Ok(None);
        }
        let domain = Domain::join(&self.config.run.id, self.config.actors.max)?;
        let answer = control::ask(&domain, question, PATIENCE);
        domain.leave()?;
        match answer {
            Ok(answer) => Ok(Some(answer)),
            Err(ControlError::Silence) if !self.run.goes_on()? => Ok(None),
            Err(error) => Err(error.into()),
        }
    }

    /// How the run gets on; `None` where it does not go on.
    pub(crate) fn status(&self) -> anyhow::Result<Option<RunStatus>> {
        match self.ask(Question::Status)? {
            None => Ok(None),
            Some(Answer::Status(status)) => Ok(Some(status)),
            Some(other) => bail!("the launcher gave an answer that does not fit: {other:?}"),
        }
    }

    /// Has the launcher do something.
    pub(crate) fn command(&self, question: Question) -> anyhow::Result<()> {
        let here = self.run.path().display();
        match self.ask(question)? {
            None => bail!("nothing runs in {here}; `shoal resume {here}` goes on with it"),
            Some(Answer::Accepted) => Ok(()),
            Some(Answer::Refused(reason)) => bail!("{reason}"),
            Some(other) => bail!("the launcher gave an answer that does not fit: {other:?}"),
        }
    }
}
