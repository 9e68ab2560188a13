//! Suites of runs: `shoal train --seeds` and `--sweep`, and `shoal resume SUITE`, which continues one.

mod progress;

use std::io::Write;
use std::path::Path;
use std::process::ExitCode;

use anyhow::{Context, bail};
use progress::SuiteProgress;
use serde::Serialize;
use shoal_common::message::say;
use shoal_common::run_dir::RunDir;
use shoal_report::page;
use shoal_run::evaluation::SavedPolicy;
use shoal_run::evaluation::final_evaluation::FinalEvaluation;
use shoal_run::plan::{RunOverrides, is_configuration_file};
use shoal_run::records::start::StartRecord;
use shoal_run::signals::{Signals, exit_code};
use shoal_run::status::saved_status;
use shoal_run::suite::{self, Suite, Sweep, Trial, configuration, schedule};
use shoal_run::usage::UsageError;

use super::detach;
use super::train::TrainArgs;
use super::training::OutputOptions;

/// How many runs at a time, and what is printed.
#[derive(Clone, Copy, Debug)]
pub(crate) struct SuiteOptions<'a> {
    pub(crate) jobs: Option<u16>,
    pub(crate) output: &'a OutputOptions,
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
    let what = if is_configuration_file(Path::new(what)) {
        absolute(Path::new(what))?.display().to_string()
    } else {
        what.to_owned()
    };
    let common = RunOverrides {
        from: overrides.from.as_deref().map(absolute).transpose()?,
        demonstrations: overrides.absolute_dataset()?,
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
        // An empty directory may be the user's.
        && !matches!(unfinished_files(directory)?, Some(1..))
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
    // Before anything is created: every run must have a valid configuration.
    let name = configuration::check(&suite)?;
    let directory = match &overrides.run {
        Some(path) if path.exists() => RunDir::at(path),
        Some(path) => RunDir::create(path)?,
        None => RunDir::create_next(Path::new("runs"), &format!("{name}-suite"))?,
    };
    let lock = suite::lock(directory.path())?;
    // Meanwhile another process may have begun another suite here.
    if unfinished_files(directory.path())?.is_none() {
        bail!(
            "{} exists already; choose another directory with --run",
            directory.path().display()
        );
    }
    suite.write(directory.path())?;
    StartRecord::of_this_process().write(directory.path())?;
    drop(lock);
    begin(directory.path(), options)
}

/// The number of temporary files in this directory, left by a process that was killed while it wrote `suite.json`;
/// `None` if there is anything else.
fn unfinished_files(directory: &Path) -> anyhow::Result<Option<usize>> {
    if !directory.is_dir() {
        return Ok(None);
    }
    let cannot_read = || format!("cannot read {}", directory.display());
    let mut count = 0;
    for entry in std::fs::read_dir(directory).with_context(cannot_read)? {
        let name = entry.with_context(cannot_read)?.file_name();
        if !name.to_string_lossy().starts_with("suite.json.") {
            return Ok(None);
        }
        count += 1;
    }
    Ok(Some(count))
}

/// Trains the suite in this directory, here or in a process that outlives this terminal.
fn begin(directory: &Path, options: SuiteOptions<'_>) -> anyhow::Result<ExitCode> {
    if options.output.detach {
        let jobs = options.jobs.map(|jobs| format!("--jobs={jobs}").into());
        return detach::resume_suite(directory, &jobs.into_iter().collect::<Vec<_>>(), options.output);
    }
    resume(directory, options)
}

/// Trains all runs of the suite in this directory that have not finished.
pub(crate) fn resume(directory: &Path, options: SuiteOptions<'_>) -> anyhow::Result<ExitCode> {
    let directory =
        &std::fs::canonicalize(directory).with_context(|| format!("cannot resolve {}", directory.display()))?;
    let _lock = suite::lock(directory)?;
    let signals = Signals::register()?;
    let mut suite = Suite::open(directory)?;
    let mut progress = SuiteProgress::new(directory, options.output.quiet);
    let failed = schedule::train(&mut suite, directory, options.jobs, &signals, &mut progress)?;
    report(&suite, directory, options.output)?;
    let here = directory.display();
    match (signals.received(), failed) {
        (None, 0) => Ok(ExitCode::SUCCESS),
        (None, failed) => bail!("{failed} of the runs failed; to continue with them: shoal resume {here}"),
        (Some(signal), _) => {
            say(format!("interrupted; to continue: shoal resume {here}"));
            Ok(exit_code(signal))
        }
    }
}

/// Prints what came out: a line for each setting, and which is best; with `--json` an object about the runs.
fn report(suite: &Suite, directory: &Path, output: &OutputOptions) -> anyhow::Result<()> {
    let here = directory.display();
    if !output.quiet {
        let runs = suite
            .runs(directory)
            .iter()
            .map(|run| RunDir::open(run))
            .collect::<Result<Vec<_>, _>>()?;
        page::ranking(&runs)?.iter().for_each(say);
        say(format!("{here}\n  compare the runs: shoal report {here}"));
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
        ended_early: suite.was_ended_early(trial),
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
