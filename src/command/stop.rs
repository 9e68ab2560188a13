//! `shoal stop`: ends a run in order.

use std::io::Write;
use std::time::{Duration, Instant};

use anyhow::bail;
use shoal_common::channel::control::Question;

use crate::cli::StopArgs;
use crate::remote::Remote;

/// A launcher gives its roles less than this.
const PATIENCE: Duration = Duration::from_secs(60);

/// Asks the launcher for the end, and waits until it is there.
pub(crate) fn run(args: &StopArgs) -> anyhow::Result<()> {
    let remote = Remote::open(&args.run)?;
    remote.command(Question::Stop)?;
    let asked = Instant::now();
    let here = args.run.display();
    while remote.run.goes_on()? {
        if asked.elapsed() >= PATIENCE {
            bail!(
                "{here} was asked to end and has not done so in a minute; its shoal.log may say why: {}",
                remote.run.log().display()
            );
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    writeln!(std::io::stdout(), "stopped; to go on: shoal resume {here}")?;
    Ok(())
}
