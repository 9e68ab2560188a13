//! `shoal track`: copies what a run records to a tracker. The package `shoal` of Python does it.

use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use shoal_common::run_dir::RunDir;
use shoal_run::python;
use shoal_run::suite::Suite;

#[derive(Args, Clone, Debug)]
pub(crate) struct TrackArgs {
    /// The directory of a run or suite, running or not.
    #[arg(value_name = "RUN|SUITE")]
    pub(crate) run: PathBuf,
    /// Where to.
    #[arg(long)]
    pub(crate) to: Tracker,
    /// Project or experiment of the tracker.
    #[arg(long, value_name = "NAME", default_value = "shoal")]
    pub(crate) project: String,
    /// Copy what is there now, and do not wait for the end.
    #[arg(long)]
    pub(crate) once: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Tracker {
    /// Weights & Biases, through its Python package wandb; `WANDB_MODE=offline` needs no account.
    Wandb,
    /// `MLflow`, through its Python package mlflow, in the store of `MLFLOW_TRACKING_URI`.
    Mlflow,
}

/// Replaces this process by `python3 -m shoal.track`.
pub(crate) fn run(args: &TrackArgs) -> anyhow::Result<()> {
    if Suite::read(&args.run)?.is_none() {
        RunDir::open(&args.run)?;
    }
    let to = match args.to {
        Tracker::Wandb => "wandb",
        Tracker::Mlflow => "mlflow",
    };
    let mut command = python::module("shoal.track")?;
    // A directory may begin with a hyphen.
    command.arg(Path::new(".").join(&args.run));
    command.args(["--to", to]).arg(format!("--project={}", args.project));
    if args.once {
        command.arg("--once");
    }
    Err(command.exec().into())
}
