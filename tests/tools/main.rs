//! Tools around training: export of policies, list of runs, completions, manual, and output on a terminal.

#![allow(clippy::unwrap_used, reason = "a test that panics has failed")]

mod export;
mod film;
mod list;
mod networks;
mod rm;
mod shell;
#[path = "../support/mod.rs"]
mod support;
mod terminal;
mod top;
