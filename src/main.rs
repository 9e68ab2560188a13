//! Shoal: the launcher, and the only binary.

mod cli;
mod command;
mod figure;
mod launcher;
mod plan;
mod recorder;
mod role;
mod rollout;
mod tensorboard;

use std::io::Write;
use std::process::ExitCode;

use clap::Parser;
use shoal_common::report::Role;

use crate::cli::{Cli, Command};

fn main() -> ExitCode {
    let result = match &Cli::parse().command {
        Command::Train(args) => command::train::run(args),
        Command::Eval(args) => command::eval::run(args).map(|()| ExitCode::SUCCESS),
        Command::Plot(args) => command::plot::run(args).map(|()| ExitCode::SUCCESS),
        Command::Bench(args) => command::bench::run(args).map(|()| ExitCode::SUCCESS),
        Command::EnvServer(args) => role::run(Role::EnvServer, args).map(|()| ExitCode::SUCCESS),
        Command::Actor(args) => role::run(Role::Actor, args).map(|()| ExitCode::SUCCESS),
        Command::Evaluator(args) => role::run(Role::Evaluator, args).map(|()| ExitCode::SUCCESS),
        Command::Learner(args) => role::run(Role::Learner, args).map(|()| ExitCode::SUCCESS),
    };
    result.unwrap_or_else(|error| {
        // Where nobody reads standard error any more, there is nobody to tell.
        let _ = writeln!(std::io::stderr(), "error: {error:#}");
        ExitCode::FAILURE
    })
}
