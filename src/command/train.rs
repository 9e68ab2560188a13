//! `shoal train`: a new run, from its plan to its result.

use std::process::ExitCode;

use super::training::conduct;
use crate::cli::TrainArgs;
use crate::plan::Plan;

/// Makes a run and trains it.
pub(crate) fn run(args: &TrainArgs) -> anyhow::Result<ExitCode> {
    let Plan { config, run, lock } = Plan::new(args)?;
    conduct(config, &run, lock, &args.telling)
}
