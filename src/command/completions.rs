//! `shoal completions`: shell code that asks this program for completions.

use std::io::Write;

use anyhow::Context;
use clap::Args;
use clap_complete::Shell;
use clap_complete::env::Shells;

use crate::completion::VARIABLE;

#[derive(Args, Clone, Debug)]
pub(crate) struct CompletionsArgs {
    /// The shell.
    #[arg(value_enum)]
    pub(crate) shell: Shell,
}

/// Prints the lines for the shell's start-up file. They call `shoal`, so they need no change after an update of it.
pub(crate) fn run(args: &CompletionsArgs) -> anyhow::Result<()> {
    let name = args.shell.to_string();
    let shells = Shells::builtins();
    let shell = shells
        .completer(&name)
        .with_context(|| format!("no completions for {name}"))?;
    let mut lines = Vec::new();
    shell.write_registration(VARIABLE, "shoal", "shoal", "shoal", &mut lines)?;
    std::io::stdout().write_all(&lines)?;
    Ok(())
}
