//! `shoal train`: a new run, from its plan to its result.

use std::process::ExitCode;

use anyhow::Context;

use super::help_config;
use super::training::conduct;
use crate::cli::TrainArgs;
use crate::plan::Plan;

/// Makes a run and trains it, or explains what can be set.
pub(crate) fn run(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    if args.help_config {
        help_config::explain(args.what.as_deref())?;
        return Ok(ExitCode::SUCCESS);
    }
    let what = args.what.as_deref().context("say what to train")?;
    let Plan { config, run, lock } = Plan::new(what, &args.choices)?;
    conduct(config, &run, lock, &args.telling)
}
