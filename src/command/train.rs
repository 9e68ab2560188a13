//! `shoal train`: a new run, from its configuration to its result.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::Args;
use clap::builder::PossibleValuesParser;
use clap_complete::engine::ArgValueCompleter;
use shoal_run::numbers::{count, small_count};
use shoal_run::plan::{Plan, RunOverrides, warning};

use super::help_config;
use super::listen::ListenArgs;
use super::training::OutputMode;
use super::training::run_training;
use crate::completion;

#[derive(Args, Clone, Debug)]
pub(crate) struct TrainArgs {
    /// What to train: frozen-lake, frozen-lake-sarsa, cart-pole, pendulum, point-mass-r1, point-mass-r2, point-mass-r3,
    /// one of the last four with -sac or -td3, gym: with a Gymnasium environment (gym:HalfCheetah-v5), or a
    /// configuration file (FILE.toml).
    #[arg(value_name = "PRESET|gym:ID|FILE.toml", required_unless_present = "help_config")]
    #[arg(add = ArgValueCompleter::new(completion::what_to_train))]
    pub(crate) what: Option<String>,
    /// Explain every key of the configuration, or those of the named preset or file, without training.
    #[arg(long)]
    pub(crate) help_config: bool,
    #[command(flatten)]
    pub(crate) overrides: RunArgs,
    #[command(flatten)]
    pub(crate) output: OutputMode,
    #[command(flatten)]
    pub(crate) listen: ListenArgs,
}

/// The settings of a run that have options of their own, and `--set`.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct RunArgs {
    /// Run directory to create [default: runs/<preset>-<n>].
    #[arg(long, value_name = "DIR")]
    pub(crate) run: Option<PathBuf>,
    /// How to learn: ddpg, td3, sac, dqn, reinforce, q-learning or sarsa [default: the preset's; for gym: the one that
    /// suits the spaces].
    #[arg(long, value_name = "METHOD", value_parser = PossibleValuesParser::new(shoal_run::method::names()))]
    pub(crate) method: Option<String>,
    /// Seed of every random stream.
    #[arg(long)]
    pub(crate) seed: Option<u64>,
    /// Actor processes.
    #[arg(long, value_name = "N", value_parser = small_count)]
    pub(crate) actors: Option<u32>,
    /// Environments of each actor.
    #[arg(long, value_name = "E", value_parser = small_count)]
    pub(crate) envs: Option<u32>,
    /// Environment steps of all actors together.
    #[arg(long, value_name = "N", value_parser = count)]
    pub(crate) steps: Option<u64>,
    /// Episodes of all actors together; the run ends at this limit or at its steps, whichever comes first.
    #[arg(long, value_name = "M", value_parser = count)]
    pub(crate) episodes: Option<u64>,
    /// Lockstep: actors and learner take turns, and the same seed and number of actors give the same bits.
    #[arg(long)]
    pub(crate) lockstep: bool,
    /// Set a key of the configuration, as in --set ddpg.tau=0.005. May be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE", add = ArgValueCompleter::new(completion::settings))]
    pub(crate) set: Vec<String>,
}

impl RunArgs {
    fn overrides(&self) -> RunOverrides {
        let Self {
            run,
            method,
            seed,
            actors,
            envs,
            steps,
            episodes,
            lockstep,
            set,
        } = self.clone();
        RunOverrides {
            run,
            method,
            seed,
            actors,
            envs,
            steps,
            episodes,
            lockstep,
            set,
        }
    }
}

/// Creates a run and trains it, or explains the configuration.
pub(crate) fn run(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    if args.help_config {
        help_config::explain(args.what.as_deref(), &args.overrides.overrides())?;
        return Ok(ExitCode::SUCCESS);
    }
    args.listen.check()?;
    let what = args
        .what
        .as_deref()
        .context("name a preset, a gym: environment or a configuration file to train")?;
    let Plan { config, run, lock } = Plan::new(what, &args.overrides.overrides())?;
    if let Some(warning) = warning(&config) {
        writeln!(std::io::stderr(), "warning: {warning}")?;
    }
    run_training(config, &run, &lock, &args.output, &args.listen).inspect_err(|_| {
        // Where no process was started there is nothing to resume or to read, and it would be in the way of the next try.
        // What is at this path by now may be somebody else's.
        if lock.check(&run).is_ok() && !run.incarnations().exists() {
            let _ = std::fs::remove_dir_all(run.path());
        }
    })
}
