//! `shoal man`: the manual pages.

use std::io::Write;
use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::Args;
use clap::Command;
use clap_mangen::Man;

#[derive(Args, Clone, Debug)]
pub(crate) struct ManArgs {
    /// Directory for the pages of all commands [default: the main page goes to standard output].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

/// Writes a page for each command into a directory, or the main page to standard output.
pub(crate) fn run(args: &ManArgs, command: Command) -> anyhow::Result<()> {
    match &args.out {
        Some(directory) => {
            write(directory, command).with_context(|| format!("cannot write the manual to {}", directory.display()))?;
            writeln!(std::io::stdout(), "{}", directory.join("shoal.1").display())?;
        }
        None => Man::new(command).render(&mut std::io::stdout().lock())?,
    }
    Ok(())
}

fn write(directory: &Path, command: Command) -> std::io::Result<()> {
    std::fs::create_dir_all(directory)?;
    clap_mangen::generate_to(command, directory)
}
