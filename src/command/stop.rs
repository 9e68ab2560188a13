//! `shoal stop`: saves a run's state and ends it.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use shoal_run::client::RunClient;

#[derive(Args, Clone, Debug)]
pub(crate) struct StopArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
}

/// Asks the launcher to end the run, and waits until it has ended.
pub(crate) fn run(args: &StopArgs) -> anyhow::Result<()> {
    RunClient::open(&args.run)?.stop()?;
    writeln!(
        std::io::stdout(),
        "stopped; to continue: shoal resume {}",
        args.run.display()
    )?;
    Ok(())
}
