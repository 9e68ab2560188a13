//! What can be typed. Nothing is decided here.

use std::ffi::OsString;
use std::path::PathBuf;

use clap::builder::PossibleValuesParser;
use clap::{Args, Parser, Subcommand};
use clap_complete::Shell;
use clap_complete::engine::ArgValueCompleter;

use crate::command::bench::Stage;
use crate::command::eval::WhichPolicy;
use crate::command::export::Format;
use crate::command::reproduce;
use crate::completion;

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
    /// Judge a run's policy on episodes with fixed starts.
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

#[derive(Args, Clone, Debug)]
pub(crate) struct TrainArgs {
    /// What to train: frozen-lake, frozen-lake-sarsa, cart-pole, pendulum, point-mass-r1, point-mass-r2, point-mass-r3,
    /// gym: and a Gymnasium environment (gym:HalfCheetah-v5), or a configuration file (FILE.toml).
    #[arg(value_name = "PRESET|gym:ID|FILE.toml", required_unless_present = "help_config")]
    #[arg(add = ArgValueCompleter::new(completion::what_to_train))]
    pub(crate) what: Option<String>,
    /// Explain every key of the configuration, or those of the named preset or file, and train nothing.
    #[arg(long)]
    pub(crate) help_config: bool,
    #[command(flatten)]
    pub(crate) choices: Choices,
    #[command(flatten)]
    pub(crate) telling: Telling,
}

/// What of a run can be said on the command line.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct Choices {
    /// Run directory to make [default: runs/<preset>-<n>].
    #[arg(long, value_name = "DIR")]
    pub(crate) run: Option<PathBuf>,
    /// Root of every random stream.
    #[arg(long)]
    pub(crate) seed: Option<u64>,
    /// Actor processes.
    #[arg(long, value_name = "N")]
    pub(crate) actors: Option<u32>,
    /// Environments of each actor.
    #[arg(long, value_name = "E")]
    pub(crate) envs: Option<u32>,
    /// Environment steps over all actors.
    #[arg(long, value_name = "N")]
    pub(crate) steps: Option<u64>,
    /// Episodes over all actors, where they come before the steps.
    #[arg(long, value_name = "M")]
    pub(crate) episodes: Option<u64>,
    /// Take turns: the same seed and actor count give the same bits.
    #[arg(long)]
    pub(crate) lockstep: bool,
    /// Override a key of the configuration, as in --set ddpg.tau=0.005. May be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE", add = ArgValueCompleter::new(completion::settings))]
    pub(crate) set: Vec<String>,
}

/// What a training run says.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct Telling {
    /// No live line and no table.
    #[arg(long)]
    pub(crate) quiet: bool,
    /// Print one JSON object on standard output at the end, and everything else on standard error.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct ResumeArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Environment steps over all actors, those already taken included [default: as before].
    #[arg(long, value_name = "N")]
    pub(crate) steps: Option<u64>,
    /// Episodes over all actors, those already over included [default: as before].
    #[arg(long, value_name = "M")]
    pub(crate) episodes: Option<u64>,
    #[command(flatten)]
    pub(crate) telling: Telling,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct StatusArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
    /// Again every second, until the run ends.
    #[arg(long)]
    pub(crate) watch: bool,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct ScaleArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Actor processes from now on.
    #[arg(long, value_name = "N")]
    pub(crate) actors: u32,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct StopArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct EvalArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Which policy to judge.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) policy: WhichPolicy,
    /// Episodes, from starts that are the same always.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) episodes: u32,
    /// Other starts than those of the run's own seed.
    #[arg(long)]
    pub(crate) seed: Option<u64>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct PlotArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Where to put the figures [default: the run directory].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct ReportArgs {
    /// Run directories; of one environment they are compared.
    #[arg(value_name = "RUN", required = true)]
    pub(crate) runs: Vec<PathBuf>,
    /// The file to write [default: report.html in the run directory; of several runs, in the working directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct ExportArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// The form of the file.
    #[arg(long, value_enum)]
    pub(crate) format: Format,
    /// Which policy to write.
    #[arg(long, value_enum, default_value_t)]
    pub(crate) policy: WhichPolicy,
    /// The file [default: <policy>.<format> in the run directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) out: Option<PathBuf>,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct ListArgs {
    /// Directory with runs in it.
    #[arg(default_value = "runs")]
    pub(crate) directory: PathBuf,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

/// What is interrupted goes on when the same is typed again; what is there is not run again.
#[derive(Args, Clone, Debug)]
pub(crate) struct ReproduceArgs {
    /// What to run; everything where nothing is named.
    #[arg(value_name = "EXPERIMENT", value_parser = PossibleValuesParser::new(reproduce::choices()))]
    pub(crate) experiments: Vec<String>,
    /// Seeds 1 to N of each experiment [default: 5, of frozen-lake and cart-pole 10 to 30; with --quick 2].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) seeds: Option<u32>,
    /// Trainings at a time [default: half the cores, for each keeps about two busy].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) jobs: Option<u16>,
    /// A first look in a few minutes: tiny networks, hardly any steps; nothing is judged.
    #[arg(long)]
    pub(crate) quick: bool,
    /// Where runs, results and figures lie [default: runs/reproduction; with --quick runs/reproduction-quick].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Where to write the report [default: REPORT.md in that directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) report: Option<PathBuf>,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct BenchArgs {
    /// What to measure.
    #[arg(value_enum)]
    pub(crate) stage: Stage,
    /// With `actors`: how many actors to measure, one after the other [default: 1,2,4, and doubled up to the cores].
    #[arg(long, value_name = "N,N,…", allow_hyphen_values = true)]
    pub(crate) actors: Option<String>,
    /// Print one JSON object on standard output.
    #[arg(long)]
    pub(crate) json: bool,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct TopArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct CompletionsArgs {
    /// The shell.
    #[arg(value_enum)]
    pub(crate) shell: Shell,
}

#[derive(Args, Clone, Debug)]
pub(crate) struct ManArgs {
    /// Where to put a page for each command [default: the first page, on standard output].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
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
