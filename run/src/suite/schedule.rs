//! Which runs of a suite are trained when: some at a time, with halving in rounds.

use std::collections::{BTreeSet, VecDeque};
use std::path::Path;
use std::process::Command;
use std::sync::mpsc::Sender;

use anyhow::bail;
use shoal_common::message::{one_line, say};
use shoal_common::run_dir::RunDir;
use signal_hook::consts::SIGTERM;

use super::configuration::{overrides_of, requested};
use super::measure::{best_return, is_evaluated, share_done};
use super::{Suite, Trial};
use crate::child_process::tied;
use crate::evaluation::best_policy::evaluate_and_keep_best;
use crate::files::is_there;
use crate::interrupted_start::remove_interrupted_start;
use crate::jobs::{TrainingEnd, run_jobs, run_training, trainings_for_all_cores};
use crate::plan::{self, Revision, RunOverrides};
use crate::preflight;
use crate::records::outcome::{OutcomeReason, RunOutcome, RunState};
use crate::records::recorder::record_final;
use crate::signals::Signals;
use crate::status::saved_status;

/// What has happened to the run of the trial with this number.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// Its training has begun.
    Started(usize),
    /// It has nothing left to do.
    Finished(usize),
    /// A signal has ended it.
    Interrupted(usize),
    /// It has done its share of a round.
    Paused(usize),
    /// It has failed, for this reason.
    Failed(usize, String),
}

/// Receives the progress of a suite's training.
pub trait Observer {
    /// The runs of the trials with the numbers `due` are trained from now on, in this order; in a round of halving each
    /// until it has done the share `until` of its steps.
    fn begin(&mut self, suite: &Suite, due: &VecDeque<usize>, until: Option<f64>);

    /// An event of one of these runs; `None` about once a second.
    fn observe(&mut self, event: Option<Event>);

    /// None of them is trained any more.
    fn end(&mut self);

    /// A round is over, in which each run has done this share of its steps. These runs have been ended early.
    fn end_round(&mut self, share: f64, ended: &[String]);
}

/// Trains all runs of the suite in this directory that have not finished, `jobs` at a time, or as many as the machine
/// allows. The caller has locked the suite. Returns how many runs have failed. Runs that were ended early do not count.
///
/// # Errors
/// When a run cannot be read or is running, or halving has nothing to judge by. A run that fails is not an error.
pub fn train(
    suite: &mut Suite,
    directory: &Path,
    jobs: Option<u16>,
    signals: &Signals,
    observer: &mut impl Observer,
) -> anyhow::Result<usize> {
    let mut failed = BTreeSet::new();
    while let Some(round) = suite.next_round() {
        let is_due = |trial: &Trial| {
            let run = directory.join(&trial.name);
            let has_done_enough = share_done(&run) >= round.share && is_evaluated(&run);
            Ok(round.trials.contains(trial) && !check_finished(suite, &run)? && !has_done_enough)
        };
        // A run that failed gets a second chance before it counts as worse: disk or memory may have been full.
        for chance in 0..2 {
            let due = Due::new(suite, directory, is_due, jobs, signals)?;
            if signals.received().is_some() || (chance > 0 && due.numbers.is_empty()) {
                break;
            }
            due.train(signals, Some(round.share), observer, &mut failed);
        }
        if signals.received().is_some() {
            break;
        }
        let result = |trial: &Trial| best_return(&directory.join(&trial.name));
        if !round.trials.iter().any(|trial| result(trial).is_finite()) {
            let (here, percent) = (directory.display(), 100.0 * round.share);
            bail!(
                "no run of {here} was evaluated in the first {percent:.0} % of its steps, so none can be preferred; \
                 lower evaluation.every with `shoal resume {here} --set evaluation.every=N`, or give the runs more steps"
            );
        }
        let ended = suite.end_worse_half(result);
        suite.write(directory)?;
        observer.end_round(round.share, &ended);
    }
    if signals.received().is_none() {
        let is_due = |trial: &Trial| {
            let run = directory.join(&trial.name);
            Ok(!suite.was_ended_early(trial) && (!check_finished(suite, &run)? || lacks_evaluation(&run)?))
        };
        Due::new(suite, directory, is_due, jobs, signals)?.train(signals, None, observer, &mut failed);
    }
    failed.retain(|number| !suite.was_ended_early(&suite.trials[*number]));
    Ok(failed.len())
}

/// The runs of a suite that are to be trained now.
struct Due<'a> {
    suite: &'a Suite,
    directory: &'a Path,
    numbers: VecDeque<usize>,
    jobs: usize,
}

impl<'a> Due<'a> {
    fn new(
        suite: &'a Suite,
        directory: &'a Path,
        is_due: impl Fn(&Trial) -> anyhow::Result<bool>,
        jobs: Option<u16>,
        signals: &Signals,
    ) -> anyhow::Result<Self> {
        let mut numbers = VecDeque::new();
        for (number, trial) in suite.trials.iter().enumerate() {
            if is_due(trial)? {
                numbers.push_back(number);
            }
        }
        // A new run locks the run whose replay it copies.
        let one_at_a_time = RunOverrides::from_arguments(&suite.arguments)?.with_replay;
        let jobs = match (jobs, numbers.front()) {
            _ if one_at_a_time => 1,
            (Some(jobs), _) => jobs.into(),
            (None, None) => 1,
            (None, Some(first)) => usual_jobs(suite, directory, *first, signals)?,
        };
        Ok(Self {
            suite,
            directory,
            numbers,
            jobs,
        })
    }

    /// Trains them, each until it has done this share of its steps. `failed` has the numbers of the trials that failed
    /// when they were trained last.
    fn train(self, signals: &Signals, until: Option<f64>, observer: &mut impl Observer, failed: &mut BTreeSet<usize>) {
        let Self {
            suite,
            directory,
            numbers,
            jobs,
        } = self;
        observer.begin(suite, &numbers, until);
        failed.retain(|number| !numbers.contains(number));
        let work = |number: usize, events: &Sender<Event>| {
            // A closed channel does not end the work.
            let _ = events.send(Event::Started(number));
            let trial = &suite.trials[number];
            let run = directory.join(&trial.name);
            // Its evaluation may come a little later.
            let has_done_enough = || until.is_some_and(|share| share_done(&run) >= share && is_evaluated(&run));
            let interrupted = || signals.received().or_else(|| has_done_enough().then_some(SIGTERM));
            let trained = train_one(suite, trial, directory, signals, &interrupted);
            let _ = events.send(match trained {
                Ok(TrainingEnd::Finished) => Event::Finished(number),
                Ok(TrainingEnd::Interrupted) if signals.received().is_none() => Event::Paused(number),
                Ok(TrainingEnd::Interrupted) => Event::Interrupted(number),
                Err(error) => Event::Failed(number, one_line(error)),
            });
        };
        run_jobs(numbers, jobs, signals, work, |event| {
            if let Some(Event::Failed(number, _)) = &event {
                failed.insert(*number);
            }
            observer.observe(event);
        });
        observer.end();
    }
}

/// The number of runs at a time that cores and shared memory allow.
fn usual_jobs(suite: &Suite, directory: &Path, first: usize, signals: &Signals) -> anyhow::Result<usize> {
    let trial = &suite.trials[first];
    let overrides = overrides_of(suite, trial)?;
    let stored = RunDir::open(&directory.join(&trial.name))
        .ok()
        .and_then(|run| run.config().ok());
    let resolve = || plan::resolve_interruptibly(&suite.what, &overrides, signals.interrupt());
    let config = stored.or_else(|| Some(resolve().ok()?.1));
    // If this fails: one. Each run checks for itself what it needs.
    let fit = config
        .and_then(|config| preflight::side_by_side(&config).ok())
        .unwrap_or(1);
    Ok(trainings_for_all_cores().min(fit.max(1)))
}

/// Whether nothing is left to do in this run directory.
fn check_finished(suite: &Suite, run: &Path) -> anyhow::Result<bool> {
    if remove_interrupted_start(run)? {
        return Ok(false);
    }
    let run = RunDir::open(run)?;
    if run.keeps_running()? {
        let here = run.path().display();
        bail!("{here} is running: end it first, with `shoal stop {here}`");
    }
    let used = run.config()?;
    let saved = saved_status(&used, &run)?;
    if !saved.finished || suite.changes.is_empty() {
        return Ok(saved.finished);
    }
    // It may be given more steps.
    let revision = Revision::new(&run, &used, &requested(suite))?;
    Ok(revision.config.run.has_all_steps(saved.env_steps, saved.episodes))
}

/// Whether a signal has ended the final evaluation of this finished run.
fn lacks_evaluation(run: &Path) -> anyhow::Result<bool> {
    let outcome = RunOutcome::read(&RunDir::open(run)?)?;
    let reason = outcome.and_then(|outcome| outcome.reason);
    Ok(matches!(reason, Some(OutcomeReason::EvaluationEnded(_))))
}

/// Makes the missing final evaluation of a finished run.
fn evaluate(run: &Path, signals: &Signals) -> anyhow::Result<TrainingEnd> {
    let run = RunDir::open(run)?.lock()?;
    let config = run.config()?;
    let saved = saved_status(&config, &run)?;
    let outcome = |state| RunOutcome::new(state, saved.env_steps, saved.episodes);
    outcome(RunState::Running)
        .with_reason(OutcomeReason::FinalEvaluation)
        .write(&run)?;
    let interrupt = signals.interrupt();
    let evaluated = evaluate_and_keep_best(&config, &run, saved.env_steps, &interrupt, |_, _| ());
    run.check()?;
    let finished = outcome(RunState::Finished);
    let Err(error) = evaluated else {
        finished.write(&run)?;
        if let Err(error) = record_final(&run, saved.env_steps) {
            say(format!("the final evaluation is not in TensorBoard's records: {error}"));
        }
        return Ok(TrainingEnd::Finished);
    };
    let signal = interrupt.signal();
    let why = OutcomeReason::of_missing_evaluation(signal, &error);
    finished.with_reason(why).write(&run)?;
    signal.map_or(Err(error), |_| Ok(TrainingEnd::Interrupted))
}

/// Trains or resumes a run as a process of its own, until it ends or `interrupted` returns a signal. A finished run is
/// evaluated.
fn train_one(
    suite: &Suite,
    trial: &Trial,
    directory: &Path,
    signals: &Signals,
    interrupted: &dyn Fn() -> Option<i32>,
) -> anyhow::Result<TrainingEnd> {
    let run = directory.join(&trial.name);
    if is_there(&run)? && check_finished(suite, &run)? {
        return evaluate(&run, signals);
    }
    let mut command = Command::new("/proc/self/exe");
    if is_there(&run)? {
        command.arg("resume").arg(&run);
    } else {
        command.arg("train").arg(&suite.what);
        // One learner thread unless something else is asked for, because other runs use the other cores.
        command.args(["--set", "learner.threads=1"]).args(&suite.arguments);
        for assignment in &trial.set {
            command.args(["--set", assignment]);
        }
        if let Some(seed) = trial.seed {
            command.args(["--seed", &seed.to_string()]);
        }
        command.arg("--run").arg(&run);
    }
    for assignment in &suite.changes {
        command.args(["--set", assignment]);
    }
    command.arg("--quiet");
    // Tied to this process: if that is killed, the run ends and can be resumed with the suite.
    run_training(&mut tied(&command)?, interrupted, || check_finished(suite, &run))
}
