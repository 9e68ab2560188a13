//! The commands. What each can be told stands beside it in `command/`.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

use crate::command::bench::BenchArgs;
use crate::command::completions::CompletionsArgs;
use crate::command::eval::EvalArgs;
use crate::command::export::ExportArgs;
use crate::command::list::ListArgs;
use crate::command::man::ManArgs;
use crate::command::plot::PlotArgs;
use crate::command::report::ReportArgs;
use crate::command::reproduce::ReproduceArgs;
use crate::command::resume::ResumeArgs;
use crate::command::scale::ScaleArgs;
use crate::command::status::StatusArgs;
use crate::command::stop::StopArgs;
use crate::command::top::TopArgs;
use crate::command::train::TrainArgs;

/// Shared-memory off-policy actor-learner: distributed reinforcement learning on one machine.
#[derive(Debug, Parser)]
#[command(name = "shoal", version, propagate_version = true)]
pub(crate) struct Cli {
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Train a policy: starts environment servers, actors, an evaluator and a learner, and ends when it has learned.
    Train(TrainArgs),
    /// Go on with a run that was stopped, or whose processes were killed.
    Resume(ResumeArgs),
    /// Show how a run gets on: every role, its rate and restarts, and who waits for whom.
    Status(StatusArgs),
    /// Change the number of actors while training goes on.
    Scale(ScaleArgs),
    /// End a run in order, so that it can be resumed.
    Stop(StopArgs),
    /// Evaluate a run's policy on episodes with fixed starts.
    Eval(EvalArgs),
    /// Draw a run's figures.
    Plot(PlotArgs),
    /// Put what there is to see of one run, or of several side by side, into one file that can be sent to anybody.
    Report(ReportArgs),
    /// Write a run's policy as a file that other programs read.
    Export(ExportArgs),
    /// List the runs in a directory: their state, how far they are, their best return.
    List(ListArgs),
    /// Run the thesis's experiments over several seeds, draw its figures, and report which of its claims hold.
    Reproduce(ReproduceArgs),
    /// Measure a stage of the system on this machine.
    Bench(BenchArgs),
    /// Watch a run on the whole terminal, and scale or stop it by a key.
    Top(TopArgs),
    /// Print what has a shell complete the commands, presets and keys, to be read by its start-up file.
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
    CleanUp(CleanUpArgs),
    #[command(hide = true)]
    Tied(TiedArgs),
}

/// How a program is started that is to end with the process that starts it.
#[derive(Args, Clone, Debug)]
pub(crate) struct TiedArgs {
    pub(crate) parent: u32,
    #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
    pub(crate) program: Vec<OsString>,
}

/// How the launcher has shared memory cleaned up.
#[derive(Args, Clone, Debug)]
pub(crate) struct CleanUpArgs {
    pub(crate) run_id: String,
}

/// How the launcher starts a role; everything else is in the run directory.
#[derive(Args, Clone, Debug)]
pub(crate) struct RoleArgs {
    pub(crate) run: PathBuf,
    pub(crate) index: u32,
    pub(crate) incarnation: u64,
}
