//! Shoal, the only binary. Each command has a file in `command/`.

mod cli;
mod command;
mod completion;
mod launcher;
mod listing;
mod log_level;
mod role;
mod status_table;
mod top;

use std::process::ExitCode;
use std::sync::Arc;

use clap::error::ErrorKind;
use clap::{CommandFactory, Parser};
use iceoryx2::prelude::{LogLevel, set_log_level};
use shoal_common::message::say;
use shoal_common::role::Role;
use shoal_run::usage::UsageError;

use crate::cli::{Cli, Command};

/// The exit code for arguments that the program cannot use.
const WRONG_USAGE: u8 = 2;

fn main() -> ExitCode {
    completion::answer(Cli::command);
    // Everything this program creates is accessible to its user alone.
    rustix::process::umask(rustix::fs::Mode::RWXG | rustix::fs::Mode::RWXO);
    // iceoryx2 also returns its errors, and they are reported once, below.
    set_log_level(LogLevel::Fatal);
    // A file-size limit must be an error of the write that exceeds it, not the end of the process.
    let registered = signal_hook::flag::register(signal_hook::consts::SIGXFSZ, Arc::default());
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(error) => return wrong_usage(&error),
    };
    let result = registered.map_err(anyhow::Error::from).and_then(|_| run(&cli.command));
    result.unwrap_or_else(|error| {
        // After a broken pipe nobody reads the message.
        if !is_broken_pipe(&error) {
            say(format!("error: {}", with_causes(&error)));
        }
        if error.is::<UsageError>() {
            WRONG_USAGE.into()
        } else {
            ExitCode::FAILURE
        }
    })
}

/// Says in one line what is wrong with the arguments, or prints what `--help` and `--version` ask for.
fn wrong_usage(error: &clap::Error) -> ExitCode {
    if !error.use_stderr() || error.kind() == ErrorKind::DisplayHelpOnMissingArgumentOrSubcommand {
        error.exit();
    }
    say(in_one_line(&error.to_string()));
    WRONG_USAGE.into()
}

/// A message of clap without the usage of the command: what is wrong, and what was probably meant.
fn in_one_line(message: &str) -> String {
    let is_about_usage = |line: &&str| line.starts_with("Usage:") || line.starts_with("For more information");
    let mut text = String::new();
    for line in message.lines().map(str::trim).take_while(|line| !is_about_usage(line)) {
        if line.is_empty() {
            continue;
        }
        if !text.is_empty() {
            // The line continues the one before it: it is a list of values, or what a colon announces.
            text += if text.ends_with(':') || line.starts_with('[') {
                " "
            } else {
                "; "
            };
        }
        text += line;
    }
    text
}

fn run(command: &Command) -> anyhow::Result<ExitCode> {
    match command {
        Command::Train(args) => command::train::run(args),
        Command::Resume(args) => command::resume::run(args),
        Command::Join(args) => command::join::run(args),
        Command::Status(args) => command::status::run(args),
        Command::Scale(args) => command::scale::run(args).map(done),
        Command::Stop(args) => command::stop::run(args).map(done),
        Command::Eval(args) => command::eval::run(args),
        Command::Plot(args) => command::plot::run(args).map(done),
        Command::Report(args) => command::report::run(args).map(done),
        Command::Film(args) => command::film::run(args),
        Command::Export(args) => command::export::run(args).map(done),
        Command::Track(args) => command::track::run(args).map(done),
        Command::Rm(args) => command::rm::run(args),
        Command::List(args) => command::list::run(args).map(done),
        Command::Reproduce(args) => command::reproduce::run(args),
        Command::Bench(args) => command::bench::run(args).map(done),
        Command::Top(args) => command::top::run(args),
        Command::Completions(args) => command::completions::run(args).map(done),
        Command::Man(args) => command::man::run(args, Cli::command()).map(done),
        Command::EnvServer(args) => role::run(Role::EnvServer, args),
        Command::Actor(args) => role::run(Role::Actor, args),
        Command::Evaluator(args) => role::run(Role::Evaluator, args),
        Command::Learner(args) => role::run(Role::Learner, args),
        Command::Gate(args) => role::run(Role::Gate, args),
        Command::Relay(args) => role::run(Role::Relay, args),
        Command::Tied(args) => shoal_run::child_process::exec_tied(args.parent, &args.program),
        Command::InNewSession(args) => command::detach::exec_in_new_session(&args.arguments),
        Command::CleanUp(args) => launcher::run_clean_up(args.launcher, &args.run_id),
    }
}

/// The error with its causes, except causes whose text it already contains.
fn with_causes(error: &anyhow::Error) -> String {
    let mut line = error.to_string();
    for cause in error.chain().skip(1).map(ToString::to_string) {
        if !line.contains(&cause) {
            line += &format!(": {cause}");
        }
    }
    line
}

fn is_broken_pipe(error: &anyhow::Error) -> bool {
    let cause = error.downcast_ref::<std::io::Error>();
    cause.is_some_and(|cause| cause.kind() == std::io::ErrorKind::BrokenPipe)
}

fn done((): ()) -> ExitCode {
    ExitCode::SUCCESS
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::{Cli, in_one_line};

    #[test]
    fn wrong_arguments_are_one_line_with_what_was_probably_meant() {
        for (arguments, parts) in [
            (
                &["train", "pendulum", "--actor", "2"][..],
                &["'--actor'", "'--actors'"][..],
            ),
            (&["train", "pendulum", "--steps", "many"], &["'many'", "--steps"]),
            (
                &["eval", "run", "--policy", "worst"],
                &["'worst'", "[possible values: best, last]"],
            ),
            (&["trian"], &["'trian'", "'train'"]),
            (&["stop"], &["not provided: <RUN>"]),
            (
                &["export", "run"],
                &["not provided: <--format <FORMAT>|--minari <DATASET>>"],
            ),
        ] {
            let error = Cli::try_parse_from([&["shoal"], arguments].concat()).unwrap_err();
            let line = in_one_line(&error.to_string());
            assert!(
                line.starts_with("error: ") && !line.contains('\n') && !line.contains("Usage"),
                "{line}"
            );
            for part in parts {
                assert!(line.contains(part), "{line}");
            }
        }
    }
}
