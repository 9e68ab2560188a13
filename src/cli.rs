//! The command line. The arguments of each command are in its file in `command/`.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::command::bench::BenchArgs;
use crate::command::completions::CompletionsArgs;
use crate::command::eval::EvalArgs;
use crate::command::export::ExportArgs;
use crate::command::film::FilmArgs;
use crate::command::join::JoinArgs;
use crate::command::list::ListArgs;
use crate::command::man::ManArgs;
use crate::command::plot::PlotArgs;
use crate::command::report::ReportArgs;
use crate::command::reproduce::ReproduceArgs;
use crate::command::resume::ResumeArgs;
use crate::command::rm::RmArgs;
use crate::command::scale::ScaleArgs;
use crate::command::status::StatusArgs;
use crate::command::stop::StopArgs;
use crate::command::top::TopArgs;
use crate::command::track::TrackArgs;
use crate::command::train::TrainArgs;

/// Reinforcement learning with many processes and shared memory.
#[derive(Debug, Parser)]
#[command(name = "shoal", version, propagate_version = true)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Train a policy with environment servers, actors, an evaluator and a learner.
    Train(TrainArgs),
    /// Continue a run that was stopped or killed.
    Resume(ResumeArgs),
    /// Join a run on another host: start actors and environment servers here.
    Join(JoinArgs),
    /// Show the status of a run: its progress, every process with its rate and restarts, and which role waits for what.
    Status(StatusArgs),
    /// Change the number of actors during training.
    Scale(ScaleArgs),
    /// Save a run's state and end it; it can be resumed.
    Stop(StopArgs),
    /// Evaluate a run's policy on episodes with fixed start states.
    Eval(EvalArgs),
    /// Draw a run's figures.
    Plot(PlotArgs),
    /// Write an interactive report of one run, or of several side by side, into a single HTML file.
    Report(ReportArgs),
    /// Play a run's policy and write what is seen into a GIF or a video.
    Film(FilmArgs),
    /// Write a run's policy into a file for other programs.
    Export(ExportArgs),
    /// Copy what a run records to Weights & Biases or MLflow.
    Track(TrackArgs),
    /// Remove runs, or their replays alone.
    Rm(RmArgs),
    /// List the runs in a directory with their state, progress and best return.
    List(ListArgs),
    /// Run the thesis's experiments with several seeds, draw its figures, and report which of its claims hold.
    Reproduce(ReproduceArgs),
    /// Measure a stage of the system on this machine.
    Bench(BenchArgs),
    /// Watch a run on the full terminal, and scale or stop it with a key.
    Top(TopArgs),
    /// Print shell code that completes commands, presets and keys, for the shell's start-up file.
    Completions(CompletionsArgs),
    /// Write the manual pages.
    Man(ManArgs),
    #[command(hide = true)]
    EnvServer(RoleArgs),
    #[command(hide = true)]
    Actor(RoleArgs),
    #[command(hide = true)]
    Evaluator(RoleArgs),
    #[command(hide = true)]
    Learner(RoleArgs),
    #[command(hide = true)]
    Gate(RoleArgs),
    #[command(hide = true)]
    Relay(RoleArgs),
    #[command(hide = true)]
    CleanUp(CleanUpArgs),
    #[command(hide = true)]
    Tied(TiedArgs),
    #[command(hide = true)]
    InNewSession(InNewSessionArgs),
}

/// The arguments with which this program is started again in a new session.
#[derive(Args, Clone, Debug)]
pub(crate) struct InNewSessionArgs {
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    pub(crate) arguments: Vec<OsString>,
}

/// Arguments for starting a program that is killed when its parent process dies.
#[derive(Args, Clone, Debug)]
pub(crate) struct TiedArgs {
    pub(crate) parent: u32,
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    pub(crate) program: Vec<OsString>,
}

/// The arguments with which the launcher starts a clean-up of shared memory.
#[derive(Args, Clone, Debug)]
pub(crate) struct CleanUpArgs {
    pub(crate) launcher: u32,
    pub(crate) run_id: String,
}

/// The arguments with which the launcher starts a role. Everything else is in the run directory.
#[derive(Args, Clone, Debug)]
pub(crate) struct RoleArgs {
    pub(crate) run: PathBuf,
    pub(crate) index: u32,
    pub(crate) incarnation: u64,
}
