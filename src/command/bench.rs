//! `shoal bench`: how fast each stage is on this machine.

use crate::cli::BenchArgs;

/// A stage of the system.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Stage {
    /// Whole DDPG updates a second, sampling included.
    Learner,
    /// Rows a second from an actor process into the committed replay of a learner process.
    Transitions,
    /// Round trip between an actor process and an environment server process.
    Step,
    /// Actions a second.
    Policy,
}

pub(crate) fn run(_args: &BenchArgs) -> anyhow::Result<()> {
    anyhow::bail!("under construction")
}
