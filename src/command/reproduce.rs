//! `shoal reproduce`: the thesis's experiments over several seeds, and a report of what holds.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::bail;
use clap::Args;
use clap::builder::PossibleValuesParser;
use shoal_report::figure::CAN_RASTERISE;
use shoal_reproduce::{BatchEnding, Effort, Order};
use shoal_run::signals::exit_code;

/// What is interrupted goes on when the same is typed again; what is there is not run again.
#[derive(Args, Clone, Debug)]
pub(crate) struct ReproduceArgs {
    /// What to run; everything where nothing is named.
    #[arg(value_name = "EXPERIMENT", value_parser = PossibleValuesParser::new(choices()))]
    pub(crate) experiments: Vec<String>,
    /// Seeds 1 to N of each experiment [default: 5, of frozen-lake and cart-pole 10 to 30; with --quick 2].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub(crate) seeds: Option<u32>,
    /// Trainings at a time [default: half the cores, for each keeps about two busy].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) jobs: Option<u16>,
    /// A first look in a minute or two: tiny networks, hardly any steps; nothing is checked.
    #[arg(long)]
    pub(crate) quick: bool,
    /// Where runs, results and figures lie [default: runs/reproduction; with --quick runs/reproduction-quick].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Draw every figure as PNG too, beside the SVG; needs a build with `--features png`.
    #[arg(long)]
    pub(crate) png: bool,
    /// Where to write the report [default: REPORT.md in that directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) report: Option<PathBuf>,
}

/// What stands for every experiment on the command line.
const ALL: &str = "all";

/// What can be asked for.
pub(crate) fn choices() -> Vec<&'static str> {
    shoal_reproduce::names().chain([ALL]).collect()
}

/// As many trainings at a time as keep this machine busy: each takes about two cores.
fn usual_jobs() -> usize {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    (cores / 2).max(1)
}

/// Runs what was asked for and says where the report is.
pub(crate) fn run(args: &ReproduceArgs) -> anyhow::Result<ExitCode> {
    if args.png && !CAN_RASTERISE {
        bail!("--png: this program was built without it; build it again with: cargo build --release --features png");
    }
    let (effort, usual) = if args.quick {
        (Effort::Quick, "runs/reproduction-quick")
    } else {
        (Effort::Full, "runs/reproduction")
    };
    let folder = args.out.clone().unwrap_or_else(|| PathBuf::from(usual));
    let report = args.report.clone().unwrap_or_else(|| folder.join("REPORT.md"));
    let all = args.experiments.iter().any(|name| name == ALL);
    let order = Order {
        experiments: if all { Vec::new() } else { args.experiments.clone() },
        seeds: args.seeds,
        jobs: args.jobs.map_or_else(usual_jobs, usize::from),
        effort,
        folder,
        png: args.png,
        report,
    };
    let ending = shoal_reproduce::run(&order)?;
    writeln!(std::io::stdout().lock(), "{}", order.report.display())?;
    let mut stderr = std::io::stderr().lock();
    Ok(match ending {
        BatchEnding::Complete => ExitCode::SUCCESS,
        BatchEnding::Failed(seeds) => {
            writeln!(
                stderr,
                "error: {seeds} of the seeds failed; type the same again to go on with them"
            )?;
            ExitCode::FAILURE
        }
        BatchEnding::Interrupted(signal) => {
            writeln!(
                stderr,
                "interrupted; every training is saved: type the same again to go on"
            )?;
            exit_code(signal)
        }
    })
}
