//! `shoal scale`: more or fewer actors during training.

use std::io::Write;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::bail;
use clap::Args;
use shoal_run::client::RunClient;
use shoal_run::numbers::parse_small_count;

#[derive(Args, Clone, Debug)]
pub(crate) struct ScaleArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// New number of actor processes.
    #[arg(long, value_name = "N", value_parser = parse_small_count)]
    pub(crate) actors: u32,
}

/// How long the change may take. Retiring actors first hand over their transitions, which the learner may take slowly.
const PATIENCE: Duration = Duration::from_secs(60);

/// Requests this number of actors, and waits until all of them are at work.
pub(crate) fn run(args: &ScaleArgs) -> anyhow::Result<()> {
    let client = RunClient::open(&args.run)?;
    client.scale(args.actors)?;
    let (asked, here) = (Instant::now(), args.run.display());
    loop {
        match client.status()? {
            None => bail!("{here} has ended meanwhile"),
            Some(status) if status.actors != args.actors => {
                bail!("another command scaled {here} to {} actors", status.actors)
            }
            Some(status) if status.all_actors_work() => break,
            Some(_) if asked.elapsed() >= PATIENCE => {
                bail!(
                    "{here} does not have {} actors at work after {PATIENCE:?}; `shoal status {here}` shows them",
                    args.actors
                )
            }
            Some(_) => std::thread::sleep(Duration::from_millis(50)),
        }
    }
    writeln!(std::io::stdout(), "{here}: actors: {}", args.actors)?;
    Ok(())
}
