//! `shoal stop`: ends a run in order.

use std::io::Write;
use std::path::PathBuf;

use clap::Args;
use shoal_run::remote::Remote;

#[derive(Args, Clone, Debug)]
pub(crate) struct StopArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
}

/// Asks the launcher for the end, and waits until it is there.
pub(crate) fn run(args: &StopArgs) -> anyhow::Result<()> {
    Remote::open(&args.run)?.stop()?;
    writeln!(
        std::io::stdout(),
        "stopped; to go on: shoal resume {}",
        args.run.display()
    )?;
    Ok(())
}
