//! `shoal resume`: a run that was stopped, or whose processes were killed, goes on.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use clap::Args;
use shoal_common::run_dir::RunDir;
use shoal_run::server_location::ServerLocation;
use shoal_run::status;

use super::training::OutputMode;
use super::training::run_training;

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
    pub(crate) output: OutputMode,
}

/// Goes on with the run's own replay, counters and noise, to the steps it was to take or to others.
pub(crate) fn run(args: &ResumeArgs) -> anyhow::Result<ExitCode> {
    let run = RunDir::open(&args.run)?;
    let mut config = run.config()?;
    // Only who holds the lock may change the configuration.
    let lock = run.lock()?;
    let here = args.run.display();
    let rest = status::at_rest(&config, &run).with_context(|| format!("cannot resume {here}"))?;
    let (taken, over) = (rest.env_steps, rest.episodes);
    let steps = args.steps.unwrap_or(config.run.steps);
    let episodes = args.episodes.or(config.run.episodes);
    // Where all steps are taken, updates or the last evaluation may be left.
    if rest.finished || (steps, episodes) != (config.run.steps, config.run.episodes) {
        if taken >= steps {
            bail!("{here} has taken {taken} of {steps} steps already: give it more with --steps");
        }
        if let Some(episodes) = episodes.filter(|episodes| over >= *episodes) {
            bail!("{here} has finished {over} of {episodes} episodes already: give it more with --episodes");
        }
    }
    // Found now, and not by roles that fail one after the other.
    ServerLocation::of_run(&run).with_context(|| format!("cannot resume {here}"))?;
    if (steps, episodes) != (config.run.steps, config.run.episodes) {
        (config.run.steps, config.run.episodes) = (steps, episodes);
        config.check()?;
        run.write_config(&config)?;
    }
    run_training(config, &run, lock, &args.output)
}
