//! `shoal scale`: more or fewer actors during training.

use std::io::Write;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::bail;
use clap::Args;
use shoal_common::channel::control::{HostState, HostStatus, RunStatus, ScaleRequest};
use shoal_run::client::RunClient;
use shoal_run::numbers::parse_small_count;

#[derive(Args, Clone, Debug)]
#[command(group = clap::ArgGroup::new("numbers").required(true).multiple(true))]
pub(crate) struct ScaleArgs {
    /// Run directory.
    pub(crate) run: PathBuf,
    /// New number of actor processes; where other hosts have joined, that of this host, which is the learner's.
    #[arg(long, value_name = "N", value_parser = parse_small_count, group = "numbers")]
    pub(crate) actors: Option<u32>,
    /// New number of actors of a joined host. It ends its processes and joins again. May be given several times.
    #[arg(long, value_name = "NAME=N", value_parser = parse_host, group = "numbers")]
    pub(crate) host: Vec<(String, u32)>,
    /// New number of actors on all hosts together. They are shared out by processor cores. A host that --actors or
    /// --host names keeps its number there.
    #[arg(long, value_name = "N", value_parser = parse_small_count, group = "numbers")]
    pub(crate) total: Option<u32>,
}

/// How long the change may take. Retiring actors first hand over their transitions, which the learner may take slowly.
const TIMEOUT: Duration = Duration::from_secs(60);

/// Reads a host's name and its number of actors.
fn parse_host(text: &str) -> Result<(String, u32), String> {
    let (name, actors) = text
        .rsplit_once('=')
        .ok_or("write a host's name and its number of actors: node-2=8")?;
    Ok((name.into(), parse_small_count(actors)?))
}

/// Requests these numbers of actors, and waits until all of them are at work.
pub(crate) fn run(args: &ScaleArgs) -> anyhow::Result<()> {
    let client = RunClient::open(&args.run)?;
    let (here, total) = client.scale(ScaleRequest {
        here: args.actors,
        joined: args.host.clone(),
        total: args.total,
    })?;
    let (asked, run) = (Instant::now(), args.run.display());
    loop {
        match client.status()? {
            None => bail!("{run} has ended meanwhile"),
            Some(status) if status.actors != here => {
                bail!("another command scaled {run} to {} actors", status.actors)
            }
            Some(status) if all_work(&status, here, total) => break,
            Some(_) if asked.elapsed() >= TIMEOUT => {
                bail!("{run} does not have {total} actors at work after {TIMEOUT:?}; `shoal status {run}` shows them")
            }
            Some(_) => std::thread::sleep(Duration::from_millis(50)),
        }
    }
    if total == here {
        writeln!(std::io::stdout(), "{run}: actors: {here}")?;
    } else {
        writeln!(std::io::stdout(), "{run}: actors: {total}, of them {here} on this host")?;
    }
    Ok(())
}

/// Whether this host and the joined ones have these actors, and all of them have started.
fn all_work(status: &RunStatus, here: u32, total: u32) -> bool {
    let joined: u32 = status.hosts.iter().map(|host| host.actors).sum();
    // A host that has not told of its processes has just joined.
    let works = |host: &HostStatus| {
        host.state == HostState::Connected && host.actors == host.wanted_actors && !host.roles.is_empty()
    };
    status.all_actors_work() && here + joined == total && status.hosts.iter().all(works)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_has_a_name_and_a_number() {
        assert_eq!(parse_host("node-2=8"), Ok(("node-2".into(), 8)));
        assert_eq!(parse_host("a=b=1"), Ok(("a=b".into(), 1)));
        for wrong in ["node-2", "node-2=", "node-2=x", "8"] {
            assert!(parse_host(wrong).is_err(), "{wrong}");
        }
    }
}
