//! What surrounds training: the policy exported, runs listed, the shell's completions, the manual, and the terminal.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod export;
mod list;
mod networks;
mod shell;
#[path = "../support/mod.rs"]
mod support;
mod terminal;
mod top;
