//! `shoal reproduce`: the thesis's experiments with several seeds, and a report of which claims hold.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::bail;
use clap::Args;
use clap::builder::PossibleValuesParser;
use shoal_report::figure::CAN_RASTERISE;
use shoal_reproduce::{Effort, ReproductionEnd, Request};
use shoal_run::jobs::trainings_for_all_cores;
use shoal_run::numbers::parse_positive_count;
use shoal_run::signals::exit_code;

/// Repeating an interrupted command continues it. Finished trainings are not run again.
#[derive(Args, Clone, Debug)]
pub(crate) struct ReproduceArgs {
    /// What to run [default: everything].
    #[arg(value_name = "EXPERIMENT", value_parser = PossibleValuesParser::new(choices()))]
    pub(crate) experiments: Vec<String>,
    /// Run seeds 1 to N of each experiment [default: 5; 10 to 30 for frozen-lake and cart-pole; 3 to 10 for
    /// methods; 2 with --quick].
    #[arg(long, value_name = "N", value_parser = parse_positive_count)]
    pub(crate) seeds: Option<u32>,
    /// Number of trainings at a time [default: half the cores, because each training keeps about two busy].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    pub(crate) jobs: Option<u16>,
    /// A first look in a minute or two, with tiny networks and few steps. No claims are checked.
    #[arg(long)]
    pub(crate) quick: bool,
    /// Directory for runs, results and figures [default: runs/reproduction; with --quick runs/reproduction-quick].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
    /// Draw every figure as PNG in addition to SVG; needs a build with `--features png`.
    #[arg(long)]
    pub(crate) png: bool,
    /// File for the report [default: REPORT.md in that directory].
    #[arg(long, value_name = "FILE")]
    pub(crate) report: Option<PathBuf>,
}

/// The name for all experiments on the command line.
const ALL: &str = "all";

/// The possible arguments: the experiments, and all of them.
pub(crate) fn choices() -> Vec<&'static str> {
    shoal_reproduce::names().chain([ALL]).collect()
}

/// Runs the chosen experiments and prints the path of the report.
pub(crate) fn run(args: &ReproduceArgs) -> anyhow::Result<ExitCode> {
    if args.png && !CAN_RASTERISE {
        bail!("--png: this program was built without PNG support; rebuild it: cargo build --release --features png");
    }
    let (effort, usual) = if args.quick {
        (Effort::Quick, "runs/reproduction-quick")
    } else {
        (Effort::Full, "runs/reproduction")
    };
    let folder = args.out.clone().unwrap_or_else(|| PathBuf::from(usual));
    let report = args.report.clone().unwrap_or_else(|| folder.join("REPORT.md"));
    let all = args.experiments.iter().any(|name| name == ALL);
    let request = Request {
        experiments: if all { Vec::new() } else { args.experiments.clone() },
        seeds: args.seeds,
        parallel: args.jobs.map_or_else(trainings_for_all_cores, usize::from),
        effort,
        folder,
        png: args.png,
        report,
    };
    let ending = shoal_reproduce::run(&request)?;
    writeln!(std::io::stdout().lock(), "{}", request.report.display())?;
    let mut stderr = std::io::stderr().lock();
    Ok(match ending {
        ReproductionEnd::Complete => ExitCode::SUCCESS,
        ReproductionEnd::Failed(seeds) => {
            writeln!(
                stderr,
                "error: {seeds} of the seeds failed; repeat the command to continue with them"
            )?;
            ExitCode::FAILURE
        }
        ReproductionEnd::Interrupted(signal) => {
            writeln!(
                stderr,
                "interrupted; every training is saved: repeat the command to continue"
            )?;
            exit_code(signal)
        }
    })
}
