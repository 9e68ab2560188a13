//! `shoal man`: the manual pages.

use std::io::Write;
use std::path::Path;

use anyhow::Context;
use clap::CommandFactory;
use clap_mangen::Man;

use crate::cli::{Cli, ManArgs};

/// Writes a page for each command into a directory, or the first page to standard output.
pub(crate) fn run(args: &ManArgs) -> anyhow::Result<()> {
    match &args.out {
        Some(directory) => {
            write(directory).with_context(|| format!("cannot write the manual to {}", directory.display()))?;
            writeln!(std::io::stdout(), "{}", directory.join("shoal.1").display())?;
        }
        None => Man::new(Cli::command()).render(&mut std::io::stdout().lock())?,
    }
    Ok(())
}

fn write(directory: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(directory)?;
    clap_mangen::generate_to(Cli::command(), directory)
}
