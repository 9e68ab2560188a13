//! `shoal reproduce`: the thesis's experiments over several seeds, and a report of what holds.

use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;

use crate::cli::ReproduceArgs;
use crate::reproduction::{self, Effort, Ending, Order};

/// What stands for every experiment on the command line.
const ALL: &str = "all";

/// What can be asked for.
pub(crate) fn choices() -> Vec<&'static str> {
    reproduction::names().chain([ALL]).collect()
}

/// As many trainings at a time as keep this machine busy: each takes about two cores.
fn usual_jobs() -> usize {
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    (cores / 2).max(1)
}

/// Runs what was asked for and says where the report is.
pub(crate) fn run(args: &ReproduceArgs) -> anyhow::Result<ExitCode> {
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
        report,
    };
    let ending = reproduction::run(&order)?;
    writeln!(std::io::stdout().lock(), "{}", order.report.display())?;
    let mut stderr = std::io::stderr().lock();
    Ok(match ending {
        Ending::Complete => ExitCode::SUCCESS,
        Ending::Failed(seeds) => {
            writeln!(
                stderr,
                "error: {seeds} of the seeds failed; type the same again to go on with them"
            )?;
            ExitCode::FAILURE
        }
        Ending::Interrupted(signal) => {
            writeln!(
                stderr,
                "interrupted; every training is saved: type the same again to go on"
            )?;
            // As a shell reports a process that the signal ended.
            ExitCode::from(128 + signal as u8)
        }
    })
}
