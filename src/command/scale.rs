//! `shoal scale`: more actors, or fewer, while training goes on.

use std::io::Write;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::bail;
use clap::Args;
use shoal_common::channel::control::{RoleState, RunStatus};
use shoal_common::report::Role;
use shoal_run::remote::Remote;

#[derive(Args, Clone, Debug)]
pub(crate) struct ScaleArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// Actor processes from now on.
    #[arg(long, value_name = "N")]
    pub(crate) actors: u32,
}

/// Actors that retire hand over what they have first: the learner may take its time over it.
const PATIENCE: Duration = Duration::from_secs(60);

/// Asks for so many actors, and waits until there are.
pub(crate) fn run(args: &ScaleArgs) -> anyhow::Result<()> {
    let remote = Remote::open(&args.run)?;
    remote.scale(args.actors)?;
    let (asked, here) = (Instant::now(), args.run.display());
    loop {
        match remote.status()? {
            None => bail!("{here} has ended meanwhile"),
            Some(status) if status.actors != args.actors => bail!("somebody else scaled {here} to {}", status.actors),
            Some(status) if is_at_work(&status) => break,
            Some(_) if asked.elapsed() >= PATIENCE => {
                bail!(
                    "the actors of {here} are not {} yet; `shoal status {here}` shows them",
                    args.actors
                )
            }
            Some(_) => std::thread::sleep(Duration::from_millis(50)),
        }
    }
    writeln!(std::io::stdout(), "{here}: actors: {}", args.actors)?;
    Ok(())
}

/// Whether the actors are those wanted, all of them past their start.
fn is_at_work(status: &RunStatus) -> bool {
    let mut actors = status.roles.iter().filter(|role| role.role == Role::Actor.name());
    actors.clone().count() == status.actors as usize
        && !actors.any(|actor| {
            matches!(
                actor.state,
                RoleState::Starting | RoleState::Restarting | RoleState::Retiring
            )
        })
}
