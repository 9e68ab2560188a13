//! `shoal train`: a new run, from its configuration to its result.

use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use clap_complete::engine::ArgValueCompleter;
use shoal_common::message::say;
use shoal_common::run_dir::RunDir;
use shoal_run::plan::{Plan, RunOverrides, preset_patterns};
use shoal_run::suite;
use shoal_run::usage::UsageError;

use super::listen::ListenArgs;
use super::training::{OutputOptions, run_training};
use super::{detach, help_config};
use crate::{completion, launcher};

#[derive(Args, Clone, Debug)]
pub(crate) struct TrainArgs {
    #[arg(help = help_of_what())]
    #[arg(value_name = "PRESET|gym:ID|FILE.toml", required_unless_present = "help_config")]
    #[arg(add = ArgValueCompleter::new(completion::presets_and_files))]
    pub(crate) what: Option<String>,
    /// Explain every key of the configuration, or the keys that the named preset or file sets, without training.
    #[arg(long)]
    pub(crate) help_config: bool,
    #[command(flatten)]
    pub(crate) overrides: RunOverrides,
    /// Train a suite: a run for each of these seeds, as in 1..5 (five seeds) or 1,4,7.
    #[arg(long, value_name = "A..B", value_parser = seeds, conflicts_with = "seed")]
    pub(crate) seeds: Option<Seeds>,
    /// Train a suite: a run for each of these values, as in --sweep ddpg.tau=0.001,0.005. Repeated: for each
    /// combination.
    #[arg(long, value_name = "SECTION.KEY=A,B,C", add = ArgValueCompleter::new(completion::settings))]
    pub(crate) sweep: Vec<String>,
    /// End bad settings of a suite early: the worse half at 1/4 of the steps, for example, and again at 1/2.
    #[arg(long, requires = "sweep")]
    pub(crate) halving: bool,
    /// Runs of a suite at a time [default: what cores and /dev/shm allow].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) jobs: Option<u16>,
    #[command(flatten)]
    pub(crate) output: OutputOptions,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
}

fn help_of_what() -> String {
    format!(
        "What to train: a preset ({}), gym: with a Gymnasium environment (gym:HalfCheetah-v5), or a configuration file \
         (FILE.toml)",
        preset_patterns()
    )
}

/// The seeds of a suite.
#[derive(Clone, Debug)]
pub(crate) struct Seeds(pub(crate) Vec<u64>);

fn seeds(text: &str) -> Result<Seeds, String> {
    suite::seeds(text).map(Seeds)
}

/// Creates a run and trains it, or explains the configuration.
pub(crate) fn run(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    if args.help_config {
        help_config::explain(args.what.as_deref(), &args.overrides)?;
        return Ok(ExitCode::SUCCESS);
    }
    args.listen.check()?;
    let what = args
        .what
        .as_deref()
        .context("name a preset, a gym: environment or a configuration file to train")?;
    if args.seeds.is_some() || !args.sweep.is_empty() {
        if args.listen.listen.is_some() {
            return Err(
                UsageError("--listen: other hosts join a single run, without --seeds and --sweep".into()).into(),
            );
        }
        return super::suite::train(args, what, &args.overrides);
    }
    if args.jobs.is_some() {
        return Err(UsageError("--jobs: only for several runs, with --seeds or --sweep".into()).into());
    }
    let Plan {
        config,
        run,
        origin,
        warnings,
    } = Plan::new(what, &args.overrides)?;
    for warning in warnings {
        say(format!("warning: {warning}"));
    }
    if let Some(origin) = origin {
        let line = format!("{} {}", run.name(), origin.in_words());
        launcher::note(&run, &line);
        if !args.output.quiet {
            say(line);
        }
    }
    if args.output.detach {
        let run = run.unlock();
        let begun = detach::resume_run(run.path(), &args.listen.arguments(), &args.output);
        if let Ok(_lock) = run.lock()
            && was_never_started(&run)
        {
            let _ = run.remove();
        }
        return begun;
    }
    run_training(config, &run, &args.output, &args.listen).inspect_err(|_| {
        // If no process was started, the directory is removed, so that its name is free again. By now the path may
        // belong to somebody else.
        if run.check().is_ok() && was_never_started(&run) {
            let _ = run.remove();
        }
    })
}

/// Whether it is certain that no process of the run was ever started. A directory that cannot be inspected for the
/// moment may be that of a trained run.
fn was_never_started(run: &RunDir) -> bool {
    matches!(run.incarnations().try_exists(), Ok(false))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_cannot_be_inspected_may_have_been_started() {
        let parent = tempfile::tempdir().unwrap();
        let run = RunDir::at(parent.path());
        assert!(was_never_started(&run));
        // To follow it fails, also for root.
        std::os::unix::fs::symlink(run.incarnations(), run.incarnations()).unwrap();
        assert!(!was_never_started(&run));
        std::fs::remove_file(run.incarnations()).unwrap();
        std::fs::write(run.incarnations(), "").unwrap();
        assert!(!was_never_started(&run));
    }
}
