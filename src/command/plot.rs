//! `shoal plot`: the figures of a run.

use std::io::Write;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use shoal_common::run_dir::RunDir;
use shoal_report::plots;
use shoal_run::signals::Interrupt;

#[derive(Args, Clone, Debug)]
pub(crate) struct PlotArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Directory for the figures [default: the run directory].
    #[arg(long, value_name = "DIR")]
    pub(crate) out: Option<PathBuf>,
}

/// Draws all figures of a run and prints their paths.
pub(crate) fn run(args: &PlotArgs) -> anyhow::Result<()> {
    let run = RunDir::open(&args.run)?;
    let config = run.config()?;
    let out = args.out.as_deref().unwrap_or(run.path());
    std::fs::create_dir_all(out).with_context(|| format!("cannot create {}", out.display()))?;
    let mut stdout = std::io::stdout().lock();
    let drawn = plots::draw(&run, &config, out, Some(&Interrupt::default()), || Ok(()))?;
    for figure in drawn.files {
        writeln!(stdout, "{}", figure.display())?;
    }
    if let Some(why) = drawn.no_episode {
        writeln!(std::io::stderr(), "no episode was drawn: {why}")?;
    }
    Ok(())
}
