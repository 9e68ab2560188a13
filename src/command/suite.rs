//! Suites of runs: `shoal train --seeds` and `--sweep`, and `shoal resume SUITE`, which continues one.

mod measure;
mod progress;

use std::collections::{BTreeSet, VecDeque};
use std::io::Write;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::sync::mpsc::Sender;

use anyhow::{Context, bail};
use measure::{best_return, is_evaluated, share_done};
use progress::{Event, SuiteProgress};
use serde::Serialize;
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_report::page;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::final_evaluation::FinalEvaluation;
use shoal_run::external_environment::tied;
use shoal_run::interrupted_start::remove_interrupted_start;
use shoal_run::jobs::{TrainingEnd, run_jobs, run_training};
use shoal_run::plan::{self, RequestedChanges, Revision, RunOverrides};
use shoal_run::preflight;
use shoal_run::records::start::StartRecord;
use shoal_run::signals::{Signals, exit_code};
use shoal_run::status::saved_status;
use shoal_run::suite::{self, Suite, Sweep, Trial};
use shoal_run::usage::UsageError;
use signal_hook::consts::SIGTERM;

use super::detach;
use super::train::TrainArgs;
use super::training::OutputMode;

/// How many runs at a time, and what is printed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SuiteOptions<'a> {
    pub(crate) jobs: Option<u16>,
    pub(crate) output: &'a OutputMode,
}

/// The output of `--json`.
#[derive(Serialize)]
struct SuiteJson<'a> {
    suite: String,
    runs: Vec<RunJson<'a>>,
}

#[derive(Serialize)]
struct RunJson<'a> {
    run: &'a str,
    finished: bool,
    /// Whether it was ended early because its setting was bad.
    ended_early: bool,
    env_steps: u64,
    eval_return_mean: Option<f64>,
}

/// Creates the suite that is asked for and trains its runs. The same command with `--run` continues it.
pub(crate) fn train(args: &TrainArgs, what: &str, overrides: &RunOverrides) -> anyhow::Result<ExitCode> {
    let sweeps = args
        .sweep
        .iter()
        .map(|text| Sweep::parse(text))
        .collect::<Result<Vec<_>, _>>();
    let sweeps = sweeps.map_err(UsageError)?;
    let seeds: Vec<u64> = match (&args.seeds, overrides.seed) {
        (Some(seeds), _) => seeds.0.clone(),
        (None, seed) => seed.into_iter().collect(),
    };
    // The suite may be continued from another directory.
    let absolute =
        |path: &Path| std::path::absolute(path).with_context(|| format!("cannot resolve {}", path.display()));
    let what = if Path::new(what).extension().is_some_and(|extension| extension == "toml") {
        absolute(Path::new(what))?.display().to_string()
    } else {
        what.to_owned()
    };
    let common = RunOverrides {
        from: overrides.from.as_deref().map(absolute).transpose()?,
        demonstrations: overrides.demonstrations_from_anywhere()?,
        ..overrides.clone()
    };
    let suite = Suite::new(what, common.arguments(), &sweeps, &seeds)?;
    let suite = if args.halving {
        suite.with_halving().map_err(UsageError)?
    } else {
        suite
    };
    let options = SuiteOptions {
        jobs: args.jobs,
        output: &args.output,
    };
    if let Some(directory) = &overrides.run
        && directory.exists()
    {
        let here = directory.display();
        return match Suite::read(directory)? {
            Some(found) if found.has_same_runs(&suite) => begin(directory, options),
            Some(_) => bail!(
                "{here} is a suite of other runs: continue it with `shoal resume {here}`, or choose another directory with --run"
            ),
            None => bail!("{here} exists already; choose another directory with --run, or remove it"),
        };
    }
    // Before anything is made: is each of them a configuration?
    let name = check(&suite)?;
    let directory = match &overrides.run {
        Some(path) => RunDir::create(path)?,
        None => RunDir::create_next(Path::new("runs"), &format!("{name}-suite"))?,
    };
    suite.write(directory.path())?;
    StartRecord::of_this_process().write(directory.path())?;
    begin(directory.path(), options)
}

/// Trains the suite in this directory, here or in a process that outlives this terminal.
fn begin(directory: &Path, options: SuiteOptions<'_>) -> anyhow::Result<ExitCode> {
    if options.output.detach {
        let jobs = options.jobs.map(|jobs| format!("--jobs={jobs}").into());
        return detach::resume_suite(directory, &jobs.into_iter().collect::<Vec<_>>(), options.output);
    }
    resume(directory, options)
}

/// Changes all runs of the suite in this directory, each change as `SECTION.KEY=VALUE`. They are checked for each run
/// and stored, so that the suite can be interrupted.
pub(crate) fn change(directory: &Path, changes: &[String]) -> anyhow::Result<()> {
    if changes.is_empty() {
        return Ok(());
    }
    let _lock = suite::lock(directory)?;
    let mut suite = read(directory)?;
    suite.change(changes).map_err(UsageError)?;
    for trial in &suite.trials {
        let path = directory.join(&trial.name);
        if path.exists() {
            let run = RunDir::open(&path)?;
            Revision::new(&run, &run.config()?, &requested(&suite))?;
        }
    }
    check(&suite)?;
    suite.write(directory)
}

/// The suite in this directory. The caller has locked it: until then another process may have changed it.
fn read(directory: &Path) -> anyhow::Result<Suite> {
    Suite::read(directory)?.with_context(|| format!("{} is no suite any more", directory.display()))
}

fn requested(suite: &Suite) -> RequestedChanges {
    RequestedChanges {
        set: suite.changes.clone(),
        ..RequestedChanges::default()
    }
}

/// Checks the configuration of each combination of values. Returns the usual name of a run of this kind.
fn check(suite: &Suite) -> anyhow::Result<String> {
    let mut checked: Vec<&[String]> = Vec::new();
    let mut name = String::new();
    for trial in &suite.trials {
        if checked.contains(&trial.set.as_slice()) {
            continue;
        }
        checked.push(&trial.set);
        let config;
        (name, config) = plan::resolve(&suite.what, &overrides_of(suite, trial)?)?;
        check_first_round(suite, &config)?;
    }
    Ok(name)
}

/// Checks that a run is evaluated before the first round of halving ends.
fn check_first_round(suite: &Suite, config: &Config) -> anyhow::Result<()> {
    let Some(round) = suite.next_round() else {
        return Ok(());
    };
    let end = round.share * config.run.steps as f64;
    for (first, what, key) in [
        (config.evaluation.every, "evaluation comes after", "evaluation.every"),
        (config.replay.warmup.saturating_add(1), "update after", "replay.warmup"),
    ] {
        if config.run.episodes.is_none() && end < first as f64 {
            let text = format!(
                "--halving: the first round ends after {end:.0} steps of each run, and the first {what} {first}: lower \
                 {key}, or give the runs more steps"
            );
            return Err(UsageError(text).into());
        }
    }
    Ok(())
}

/// What all runs and this one of the suite override.
fn overrides_of(suite: &Suite, trial: &Trial) -> anyhow::Result<RunOverrides> {
    let common = RunOverrides::from_arguments(&suite.arguments)?;
    let set = common.set.iter().chain(&trial.set).chain(&suite.changes);
    Ok(RunOverrides {
        seed: trial.seed,
        set: set.cloned().collect(),
        ..common
    })
}

/// Trains all runs of the suite in this directory that have not finished, with halving in rounds.
pub(crate) fn resume(directory: &Path, options: SuiteOptions<'_>) -> anyhow::Result<ExitCode> {
    let directory =
        &std::fs::canonicalize(directory).with_context(|| format!("cannot resolve {}", directory.display()))?;
    let _lock = suite::lock(directory)?;
    let signals = Signals::register()?;
    let mut suite = read(directory)?;
    let mut failed = BTreeSet::new();
    while let Some(round) = suite.next_round() {
        let percent = 100.0 * round.share;
        let is_due = |trial: &Trial| {
            let run = directory.join(&trial.name);
            let has_done_enough = share_done(&run) >= round.share && is_evaluated(&run);
            Ok(round.trials.contains(trial) && !check_finished(&suite, &run)? && !has_done_enough)
        };
        // A run that failed gets a second chance before it counts as worse: disk or memory may have been full.
        for chance in 0..2 {
            let due = Due::new(&suite, directory, is_due, options)?;
            if signals.received().is_some() || (chance > 0 && due.numbers.is_empty()) {
                break;
            }
            due.say(&format!("until each has done {percent:.0} % of its steps:"));
            due.train(&signals, Some(round.share), &mut failed);
        }
        if signals.received().is_some() {
            break;
        }
        let result = |trial: &Trial| best_return(&directory.join(&trial.name));
        if !round.trials.iter().any(|trial| result(trial).is_finite()) {
            let here = directory.display();
            bail!("no run of {here} was evaluated in the first {percent:.0} % of its steps, so none can be preferred");
        }
        let ended = suite.end_worse_half(result);
        suite.write(directory)?;
        if !options.output.quiet {
            // A closed standard error is no reason to fail.
            let _ = writeln!(std::io::stderr(), "ended early at {percent:.0} %: {}", ended.join("; "));
        }
    }
    if signals.received().is_none() {
        let is_due =
            |trial: &Trial| Ok(!suite.has_ended(trial) && !check_finished(&suite, &directory.join(&trial.name))?);
        let due = Due::new(&suite, directory, is_due, options)?;
        due.say("");
        due.train(&signals, None, &mut failed);
    }
    report(&suite, directory, options.output)?;
    let here = directory.display();
    let mut stderr = std::io::stderr().lock();
    failed.retain(|number| !suite.has_ended(&suite.trials[*number]));
    match (signals.received(), failed.len()) {
        (None, 0) => Ok(ExitCode::SUCCESS),
        (None, failed) => bail!("{failed} of the runs failed; to continue with them: shoal resume {here}"),
        (Some(signal), _) => {
            let _ = writeln!(stderr, "interrupted; to continue: shoal resume {here}");
            Ok(exit_code(signal))
        }
    }
}

/// The runs of a suite that are to be trained now.
struct Due<'a> {
    suite: &'a Suite,
    directory: &'a Path,
    numbers: VecDeque<usize>,
    jobs: usize,
    quiet: bool,
}

impl<'a> Due<'a> {
    fn new(
        suite: &'a Suite,
        directory: &'a Path,
        is_due: impl Fn(&Trial) -> anyhow::Result<bool>,
        options: SuiteOptions<'_>,
    ) -> anyhow::Result<Self> {
        let mut numbers = VecDeque::new();
        for (number, trial) in suite.trials.iter().enumerate() {
            if is_due(trial)? {
                numbers.push_back(number);
            }
        }
        // A new run locks the run whose replay it copies.
        let one_at_a_time = RunOverrides::from_arguments(&suite.arguments)?.with_replay;
        let jobs = match (options.jobs, numbers.front()) {
            _ if one_at_a_time => 1,
            (Some(jobs), _) => jobs.into(),
            (None, None) => 1,
            (None, Some(first)) => usual_jobs(suite, directory, *first)?,
        };
        Ok(Self {
            suite,
            directory,
            numbers,
            jobs,
            quiet: options.output.quiet,
        })
    }

    /// Prints how many runs are to be trained, after these words.
    fn say(&self, words: &str) {
        if !self.quiet {
            let text = format!(
                "{words} {} of {} runs to train",
                self.numbers.len(),
                self.suite.trials.len()
            );
            // A closed standard error is no reason to fail.
            let _ = writeln!(std::io::stderr(), "{}", text.trim_start());
        }
    }

    /// Trains them, each until it has done this share of its steps. `failed` has the numbers of the trials that failed
    /// when they were trained last.
    fn train(self, signals: &Signals, until: Option<f64>, failed: &mut BTreeSet<usize>) {
        let Self {
            suite,
            directory,
            numbers,
            jobs,
            quiet,
        } = self;
        let due = numbers.clone();
        let mut progress = SuiteProgress::new(suite, directory, &numbers, until, quiet);
        let work = |number: usize, events: &Sender<Event>| {
            // A closed channel is no reason to stop.
            let _ = events.send(Event::Started(number));
            let trial = &suite.trials[number];
            let run = directory.join(&trial.name);
            // Its evaluation may come a little later.
            let has_done_enough = || until.is_some_and(|share| share_done(&run) >= share && is_evaluated(&run));
            let interrupted = || signals.received().or_else(|| has_done_enough().then_some(SIGTERM));
            let trained = train_one(suite, trial, directory, &interrupted);
            let _ = events.send(match trained {
                Ok(TrainingEnd::Finished) => Event::Finished(number),
                Ok(TrainingEnd::Interrupted) if signals.received().is_none() => Event::Paused(number),
                Ok(TrainingEnd::Interrupted) => Event::Interrupted(number),
                Err(error) => Event::Failed(number, format!("{error:#}").replace('\n', " ")),
            });
        };
        run_jobs(numbers, jobs, signals, work, |event| progress.observe(event));
        failed.retain(|number| !due.contains(number));
        failed.extend(progress.end());
    }
}

/// What cores and shared memory allow; each run keeps about two cores busy.
fn usual_jobs(suite: &Suite, directory: &Path, first: usize) -> anyhow::Result<usize> {
    let trial = &suite.trials[first];
    let overrides = overrides_of(suite, trial)?;
    let stored = RunDir::open(&directory.join(&trial.name))
        .ok()
        .and_then(|run| run.config().ok());
    let config = stored.or_else(|| Some(plan::resolve(&suite.what, &overrides).ok()?.1));
    // If this fails: one. Each run checks for itself what it needs.
    let fit = config
        .and_then(|config| preflight::side_by_side(&config).ok())
        .unwrap_or(1);
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    Ok((cores / 2).clamp(1, fit.max(1)))
}

/// Whether nothing is left to do in this run directory.
fn check_finished(suite: &Suite, run: &Path) -> anyhow::Result<bool> {
    if remove_interrupted_start(run)? {
        return Ok(false);
    }
    let run = RunDir::open(run)?;
    if run.is_running()? {
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

/// Trains or resumes a run as a process of its own, until it ends or `interrupted` returns a signal.
fn train_one(
    suite: &Suite,
    trial: &Trial,
    directory: &Path,
    interrupted: &dyn Fn() -> Option<i32>,
) -> anyhow::Result<TrainingEnd> {
    let run = directory.join(&trial.name);
    let mut command = Command::new("/proc/self/exe");
    if run.exists() {
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
    run_training(&mut tied(&command)?, interrupted)
}

/// Prints what came out: a line for each setting, and which is best; with `--json` an object about the runs.
fn report(suite: &Suite, directory: &Path, output: &OutputMode) -> anyhow::Result<()> {
    let here = directory.display();
    if !output.quiet {
        let runs = suite
            .runs(directory)
            .iter()
            .map(|run| RunDir::open(run))
            .collect::<Result<Vec<_>, _>>()?;
        let mut stderr = std::io::stderr().lock();
        for line in page::ranking(&runs)? {
            let _ = writeln!(stderr, "{line}");
        }
        let _ = writeln!(stderr, "{here}\n  compare the runs: shoal report {here}");
    }
    if output.json {
        let mut runs = Vec::new();
        for trial in &suite.trials {
            runs.push(run_json(suite, trial, &directory.join(&trial.name))?);
        }
        let json = SuiteJson {
            suite: here.to_string(),
            runs,
        };
        writeln!(std::io::stdout().lock(), "{}", serde_json::to_string(&json)?)?;
    }
    Ok(())
}

fn run_json<'a>(suite: &Suite, trial: &'a Trial, path: &Path) -> anyhow::Result<RunJson<'a>> {
    let mut json = RunJson {
        run: &trial.name,
        finished: false,
        ended_early: suite.has_ended(trial),
        env_steps: 0,
        eval_return_mean: None,
    };
    if let Ok(run) = RunDir::open(path) {
        let status = saved_status(&run.config()?, &run)?;
        let evaluation = FinalEvaluation::read(&run, status.env_steps)?;
        (json.finished, json.env_steps) = (status.finished, status.env_steps);
        json.eval_return_mean = evaluation.and_then(|it| it.of(SavedPolicy::Best)?.return_mean);
    }
    Ok(json)
}
