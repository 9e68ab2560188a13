//! Requests from another terminal: asks the launcher of a run for its status, for more actors, or to stop.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{anyhow, bail};
use shoal_common::channel::control::{self, ControlError, ControlRequest, ControlResponse, RunStatus, ScaleRequest};
use shoal_common::channel::{Domain, Sweeper};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

use crate::records::outcome::{OutcomeReason, RunOutcome, RunState};
use crate::status::saved_status;

/// How long a launcher may take to answer. One that is starting, or writes to a busy disk, does not answer at once.
const TIMEOUT: Duration = Duration::from_secs(10);

/// How long it may take to change the number of actors: it writes the change to the disk, in several files.
const SCALE_TIMEOUT: Duration = Duration::from_secs(60);

/// How long a run may take to end. Its roles are given less.
const STOP_TIMEOUT: Duration = Duration::from_secs(120);

/// How long the launcher of a stopped run may take to draw its figures.
const FIGURES_TIMEOUT: Duration = Duration::from_secs(60);

/// Pause before the launcher is asked again in new shared memory.
const ASK_AGAIN_PAUSE: Duration = Duration::from_millis(50);

/// A run. Requests go to its launcher, if it has one.
#[derive(Debug)]
pub struct RunClient {
    /// The run's directory.
    pub run: RunDir,
    /// The configuration that it was last used with, `config/used.toml`.
    pub config: Config,
}

impl RunClient {
    /// Opens the run in this directory.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let run = RunDir::open(path)?;
        let config = run.config()?;
        Ok(Self { run, config })
    }

    /// Asks the run's launcher; `None` if there is none, or it ends before it answers.
    fn ask(&self, request: ControlRequest, timeout: Duration) -> anyhow::Result<Option<ControlResponse>> {
        let begun = Instant::now();
        loop {
            if !self.run.is_running()? {
                return Ok(None);
            }
            let domain = Domain::join_as_client(&self.config.run.id, self.config.actors.max_on_a_host())?;
            let remaining = timeout.saturating_sub(begun.elapsed());
            let answer = self.ask_in(&domain, request.clone(), remaining);
            let left = domain.leave();
            let is_removed = |error: &anyhow::Error| matches!(error.downcast_ref(), Some(ControlError::Removed));
            if answer.as_ref().is_err_and(is_removed) && begun.elapsed() < timeout {
                std::thread::sleep(ASK_AGAIN_PAUSE);
                continue;
            }
            let answer = answer?;
            left?;
            return Ok(answer);
        }
    }

    fn ask_in(
        &self,
        domain: &Domain,
        request: ControlRequest,
        timeout: Duration,
    ) -> anyhow::Result<Option<ControlResponse>> {
        let _sweeper = Sweeper::start(domain)?;
        let is_about_status = request == ControlRequest::Status;
        // In its final evaluation a launcher has no roles, and answers nothing.
        let is_too_late = || {
            let reason = self.reason_for_no_roles();
            !is_about_status && reason.is_ok_and(|reason| reason == Some(OutcomeReason::FinalEvaluation))
        };
        let lives = || self.run.is_running().unwrap_or(true) && !is_too_late();
        match control::ask(domain, self.run.directory_id()?, request, timeout, lives) {
            Ok(ControlResponse::AnotherRun(there)) => {
                let here = self.run.path().display();
                bail!("{here} is a copy of {there}, which is running; the launcher in {here} waits for it to end")
            }
            Ok(answer) => Ok(Some(answer)),
            Err(ControlError::Gone) if is_too_late() && self.run.is_running()? => {
                bail!("{}", in_final_evaluation(&self.run))
            }
            Err(ControlError::Gone) => Ok(None),
            Err(ControlError::Missing) if domain.has_members() && self.reason_for_no_roles()?.is_none() => {
                bail!("{}", self.files_removed(domain)?)
            }
            Err(error @ (ControlError::Missing | ControlError::Silence)) if is_about_status => {
                match self.without_roles(&error)? {
                    Some(status) => Ok(Some(ControlResponse::Status(status))),
                    None => Err(error.into()),
                }
            }
            Err(error) => Err(error.into()),
        }
    }

    /// Why a launcher that has processes in shared memory cannot be asked there.
    fn files_removed(&self, domain: &Domain) -> anyhow::Result<String> {
        Ok(format!(
            "another program has removed files of {} in {}; the run's launcher makes them again within seconds, unless \
             it is suspended: try again",
            self.run.path().display(),
            domain.directory()?.display()
        ))
    }

    /// Why the launcher has no roles, as the run's outcome tells: it is starting, or in its final evaluation.
    fn reason_for_no_roles(&self) -> anyhow::Result<Option<OutcomeReason>> {
        let outcome = RunOutcome::read(&self.run)?;
        let reason = outcome.and_then(|outcome| outcome.reason);
        Ok(reason.filter(|reason| matches!(reason, OutcomeReason::Starting | OutcomeReason::FinalEvaluation)))
    }

    /// The status of a run whose launcher has no roles yet, or no longer has any, read from the run's files. `None` if
    /// the launcher has roles and should have answered.
    fn without_roles(&self, error: &ControlError) -> anyhow::Result<Option<RunStatus>> {
        let waiting = match self.reason_for_no_roles()? {
            Some(reason) => reason.to_string(),
            None if matches!(error, ControlError::Silence) => return Ok(None),
            None => match RunOutcome::read(&self.run)?.map(|outcome| outcome.state) {
                None | Some(RunState::Running) => OutcomeReason::Starting.to_string(),
                Some(_) => "starting or ending".to_owned(),
            },
        };
        self.saved(waiting).map(Some)
    }

    fn saved(&self, waiting: String) -> anyhow::Result<RunStatus> {
        Ok(RunStatus {
            waiting: Some(waiting),
            ..saved_status(&self.run.config()?, &self.run)?
        })
    }

    /// The run's status; `None` if it is not running.
    pub fn status(&self) -> anyhow::Result<Option<RunStatus>> {
        // A launcher that fails while it starts removes its shared memory, and this request with it.
        let starts = self.reason_for_no_roles()? == Some(OutcomeReason::Starting);
        let answer = match self.ask(ControlRequest::Status, TIMEOUT) {
            Err(_) if starts => Some(ControlResponse::Status(
                self.saved(OutcomeReason::Starting.to_string())?,
            )),
            answer => answer?,
        };
        match answer {
            None => Ok(None),
            Some(ControlResponse::Status(status)) => Ok(Some(status)),
            Some(other) => Err(not_accepted(other)),
        }
    }

    /// Changes the number of actors. Returns that of this host, which is the learner's, and that of all hosts together.
    pub fn scale(&self, request: ScaleRequest) -> anyhow::Result<(u32, u32)> {
        match self.ask(ControlRequest::Scale(request), SCALE_TIMEOUT)? {
            None => bail!("{}", self.not_running()),
            Some(ControlResponse::Scaled { here, total }) => Ok((here, total)),
            Some(answer) => Err(not_accepted(answer)),
        }
    }

    /// Ends the run, and waits until it has ended.
    pub fn stop(&self) -> anyhow::Result<()> {
        // A launcher that does not answer at all is noticed sooner this way.
        match self.status()? {
            None => bail!("{}", self.not_running()),
            Some(status) if is_in_final_evaluation(&status) => bail!("{}", in_final_evaluation(&self.run)),
            Some(_) => {}
        }
        let answer = self.ask(ControlRequest::Stop, STOP_TIMEOUT)?;
        let asked = Instant::now();
        while self.run.is_running()? {
            if asked.elapsed() >= FIGURES_TIMEOUT {
                let here = self.run.path().display();
                bail!("{here} was told to stop and is still running; `shoal status {here}` shows what it waits for");
            }
            std::thread::sleep(Duration::from_millis(10));
        }
        match answer {
            Some(answer) => accepted(answer),
            None if saved_status(&self.run.config()?, &self.run)?.finished => bail!("{}", self.not_running()),
            // It has ended for another reason, which its own terminal reports.
            None => Ok(()),
        }
    }

    /// Why nothing can be asked, and what continues the run. A finished run needs a new limit.
    fn not_running(&self) -> String {
        let here = self.run.path().display();
        let status = self.run.config().ok().map(|config| saved_status(&config, &self.run));
        match status.and_then(Result::ok) {
            Some(status) if status.finished => {
                let episodes = status.episodes_limit.filter(|limit| status.episodes >= *limit);
                let (unit, limit) = episodes.map_or(("steps", status.steps), |limit| ("episodes", limit));
                format!(
                    "nothing runs in {here}: it is finished; `shoal resume {here} --{unit} N` with N above {limit} \
                     continues it"
                )
            }
            _ => format!("nothing runs in {here}; `shoal resume {here}` continues it"),
        }
    }
}

/// Whether the launcher evaluates the run's policies once more.
pub fn is_in_final_evaluation(status: &RunStatus) -> bool {
    let waiting = status.waiting.clone().map(OutcomeReason::from);
    waiting == Some(OutcomeReason::FinalEvaluation)
}

/// Why a run cannot be stopped any more.
pub fn in_final_evaluation(run: &RunDir) -> String {
    format!(
        "the training in {} is finished, and its final evaluation is under way; Ctrl-C in its terminal or SIGTERM ends \
         that",
        run.path().display()
    )
}

fn accepted(answer: ControlResponse) -> anyhow::Result<()> {
    match answer {
        ControlResponse::Accepted => Ok(()),
        answer => Err(not_accepted(answer)),
    }
}

fn not_accepted(answer: ControlResponse) -> anyhow::Error {
    match answer {
        ControlResponse::Refused(reason) => anyhow!(reason),
        ControlResponse::RunIsEnding => anyhow!("the run is ending"),
        other => anyhow!("the launcher gave an unexpected answer: {other:?}"),
    }
}
