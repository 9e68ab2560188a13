//! An environment in a crate of its own: a program that Shoal starts, as `docs/PROTOCOL.md` describes.
//!
//! `examples/rail` is a whole one. Its `main` is
//!
//! ```no_run
//! # use shoal_env_server::environment::pendulum::{Pendulum, PendulumParameters};
//! # use std::process::ExitCode;
//! fn main() -> ExitCode {
//!     shoal_env_server::serve::<PendulumParameters, _>(Pendulum::new)
//! }
//! ```
//!
//! and its configuration names the program: `environment.server = ["./rail"]`.

use std::fmt::Display;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;
use serde::de::DeserializeOwned;
use shoal_base::message::say;
use shoal_base::role::{Role, RoleInstance};
use shoal_base::stop::Stop;
use shoal_base::versioned_file::VersionedFile;
use shoal_channel::environment::EnvironmentPort;
use shoal_channel::{Domain, EventName, HeartbeatSender};

use crate::description::Description;
use crate::environment::{Environment, OutOfRange};
use crate::frame::FrameFile;
use crate::server;
use crate::vector::VectorEnvironment;

/// The arguments that Shoal appends to the program's own.
#[derive(Debug, Parser)]
#[command(about = "An environment server. Shoal starts it: name it as environment.server in a configuration file.")]
struct Arguments {
    /// iceoryx2's configuration for this run. It is not read here: it follows from the run's name.
    #[arg(long)]
    iceoryx2: PathBuf,
    /// The run's name.
    #[arg(long)]
    run: String,
    /// Which server of the run this is.
    #[arg(long)]
    index: u32,
    /// The number of this start among all process starts of the run.
    #[arg(long)]
    incarnation: u64,
    /// The client, as actor/3.
    #[arg(long, value_parser = client)]
    client: (Role, u32),
    /// Environments to step together.
    #[arg(long)]
    environments: u32,
    /// The run's seed.
    #[arg(long)]
    seed: u64,
    /// A part of the seed of training episodes.
    #[arg(long)]
    stream: u64,
    /// The environment's name.
    #[arg(long)]
    name: String,
    /// Its parameters, a JSON object.
    #[arg(long)]
    parameters: String,
}

fn client(text: &str) -> Result<(Role, u32), String> {
    let (role, index) = text.split_once('/').ok_or("must be ROLE/INDEX")?;
    let role = [Role::Actor, Role::Evaluator]
        .into_iter()
        .find(|known| known.name() == role);
    let index = index.parse().map_err(|_| "its index is not a number")?;
    Ok((role.ok_or("must be actor or evaluator")?, index))
}

/// Serves the environment that `new` makes from its parameters, until Shoal ends this program. Call it from `main`, and
/// return what it returns. Parameters that the user sets and `P` does not know are refused if `P` is declared with
/// `deny_unknown_fields`.
pub fn serve<P: DeserializeOwned, E: Environment + 'static>(new: fn(P) -> Result<E, OutOfRange>) -> ExitCode {
    let arguments = Arguments::parse();
    tracing_subscriber::fmt()
        .with_writer(std::io::stderr)
        .without_time()
        .init();
    let make = || -> Result<Box<dyn Environment>, String> {
        let parameters = serde_json::from_str(&arguments.parameters).map_err(|error| error.to_string())?;
        Ok(Box::new(new(parameters).map_err(|error| error.to_string())?))
    };
    let served = serve_until_stopped(&arguments, make);
    let Err(error) = served else { return ExitCode::SUCCESS };
    // The last line is shown to the user.
    say(format!("error: environment {}: {error}", arguments.name));
    ExitCode::FAILURE
}

fn serve_until_stopped(
    arguments: &Arguments,
    make: impl Fn() -> Result<Box<dyn Environment>, String>,
) -> Result<(), String> {
    let Arguments {
        run,
        index,
        incarnation,
        client: (role, client),
        environments: count,
        seed,
        stream,
        ..
    } = arguments;
    let environments = VectorEnvironment::from_factory(make, *count, (*seed, (*index).into(), *stream))?;
    let mut environments = environments.drawn_into(FrameFile::wanted());
    // Before the first answer: the client reads it then.
    if let Some(file) = Description::wanted()
        && let Err(error) = environments.describe().store(&file)
    {
        tracing::error!("the environment is not described: {error}");
    }
    let stop = Stop::when_stdin_closes().map_err(|error| format!("cannot watch standard input: {error}"))?;
    // A server opens services that the launcher has made, so the number of actors is not needed.
    let domain = Domain::join(run, 1).map_err(in_words)?;
    let served = (|| {
        let spec = environments.spec().clone();
        let port = EnvironmentPort::open(&domain, *index, spec, environments.count(), EventName(*role, *client))?;
        let instance = RoleInstance {
            role: Role::EnvServer,
            index: *index,
            incarnation: *incarnation,
        };
        let heartbeat = HeartbeatSender::new(&domain, instance)?;
        server::run(&mut environments, &port, *seed, heartbeat, &stop)
    })();
    let left = domain.leave();
    served.map_err(in_words)?;
    left.map_err(in_words)
}

fn in_words(error: impl Display) -> String {
    error.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_is_an_actor_or_the_evaluator() {
        assert_eq!(client("actor/3"), Ok((Role::Actor, 3)));
        assert_eq!(client("evaluator/0"), Ok((Role::Evaluator, 0)));
        for wrong in ["actor", "learner/0", "actor/x", "actor/-1"] {
            assert!(client(wrong).is_err(), "{wrong}");
        }
    }
}
