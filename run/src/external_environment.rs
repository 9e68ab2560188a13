//! Environment servers that are other programs (`docs/PROTOCOL.md`): starting one, and using one outside a run to learn
//! its spaces or to evaluate a policy.

mod launch;
mod parameters;
pub mod server_location;

use std::cell::Cell;
use std::num::NonZeroU32;
use std::os::fd::AsFd;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use shoal_common::channel::environment::{
    EnvironmentClient, EnvironmentResponse, ResetRequest, ResponseFault, StepResult, spec,
};
use shoal_common::channel::{ChannelError, Domain, EventName, Listener, Services};
use shoal_common::config::EnvironmentConfig;
use shoal_common::exit::Exit;
use shoal_common::message::say;
use shoal_common::role::Role;
use shoal_common::space::EnvironmentSpec;
use shoal_common::stop::Stop;
use shoal_common::versioned_file::{VersionedFile, VersionedFileError};
use shoal_env_server::description::Description;
use shoal_env_server::frame::{self, Written};

use self::launch::cannot_start;
pub use self::launch::{LaunchSpec, serve_with, server_iceoryx2_config};
use crate::child_process::{ChildProcess, tied, wait_for_any};
use crate::external_environment::server_location::LaunchContext;
use crate::signals::{Interrupt, describe};

/// The prefix of the names of Gymnasium environments.
pub const GYMNASIUM: &str = "gym:";

/// How long a program may take to end after it has left shared memory.
const END_TIMEOUT: Duration = Duration::from_secs(2);

/// A start that takes longer is reported to the user.
const SLOW_START: Duration = Duration::from_secs(10);

/// The default command that serves environments of this name; `None` for built-in environments.
pub fn default_command(name: &str) -> Option<Vec<String>> {
    let gymnasium = || ["python3", "-m", "shoal_gym"].map(Into::into).into();
    name.starts_with(GYMNASIUM).then(gymnasium)
}

/// An environment server that serves this process. It is ended on drop.
pub struct ExternalEnvironment {
    client: EnvironmentClient,
    listener: Listener,
    spec: EnvironmentSpec,
    program: ChildProcess,
    /// Where it writes pictures, if it is asked for them.
    pictures: Option<PathBuf>,
    /// Where it has written what its numbers mean, if it does.
    description: PathBuf,
    /// Ends every wait for an answer.
    stop: Stop,
    interrupt: Interrupt,
    /// Whether the wait for an answer was given up.
    silent: Cell<bool>,
    /// The longest time that an answer may take.
    limit: Duration,
    // Dropped last, in this order.
    _services: Services,
    _domain: LeaveOnDrop,
}

/// Leaves the domain on drop and thereby removes it from shared memory.
struct LeaveOnDrop(Option<Domain>);

impl Drop for LeaveOnDrop {
    fn drop(&mut self) {
        // A later process removes what cannot be removed now.
        let _ = self.0.take().map(Domain::leave);
    }
}

impl ExternalEnvironment {
    /// Starts the environment's server with this number of environments and asks for their spaces. `seed`
    /// determines the start states of its evaluation episodes.
    ///
    /// # Errors
    /// When the server cannot be started, ends, or does not answer; with the last line it wrote.
    pub fn begin(environment: &EnvironmentConfig, environments: u32, seed: u64) -> anyhow::Result<Self> {
        Self::begin_in(
            environment,
            environments,
            seed,
            LaunchContext::default(),
            Interrupt::default(),
        )
    }

    /// As [`begin`](Self::begin), but with this location and environment variables. A signal ends this and every later
    /// wait for an answer.
    ///
    /// # Errors
    /// As for [`begin`](Self::begin), and when a signal has arrived.
    pub fn begin_in(
        environment: &EnvironmentConfig,
        environments: u32,
        seed: u64,
        launch_context: LaunchContext,
        interrupt: Interrupt,
    ) -> anyhow::Result<Self> {
        Domain::remove_abandoned()?;
        let run_id = format!("{:08x}", rand::random::<u32>());
        let domain = Domain::join(&run_id, 1)?;
        let picture_file = domain.directory()?.join("picture");
        let pictures = launch_context.picture_height.map(|height| (picture_file, height));
        let description = domain.directory()?.join("description");
        let launch = LaunchSpec {
            pictures: pictures.clone(),
            description: Some(description.clone()),
            // In the domain's directory, so that it is cleaned up with it if all processes are killed.
            iceoryx2: domain.directory()?.join("iceoryx2.toml"),
            run_id: &run_id,
            index: 0,
            incarnation: 1,
            client: EventName(Role::Evaluator, 0),
            environments,
            seed,
            stream: 0,
            launch_context,
        };
        match open(&domain, &launch, environment, &interrupt) {
            Ok(Opened {
                services,
                client,
                listener,
                spec,
                program,
                stop,
            }) => Ok(Self {
                client,
                listener,
                spec,
                program,
                pictures: pictures.map(|(file, _)| file),
                description,
                stop,
                interrupt,
                silent: Cell::new(false),
                limit: environment.start_limit(),
                _services: services,
                _domain: LeaveOnDrop(Some(domain)),
            }),
            Err(error) => {
                domain.leave()?;
                Err(error)
            }
        }
    }

    /// The server's spaces.
    pub fn spec(&self) -> &EnvironmentSpec {
        &self.spec
    }

    /// What the server says that its numbers mean; `None` if it says nothing.
    ///
    /// # Errors
    /// When what it says does not fit its spaces, or cannot be read.
    pub fn description(&self) -> anyhow::Result<Option<Description>> {
        let wrong = |what: String| anyhow::anyhow!("the environment server's description is wrong: {what}");
        let described = Description::load_if_any(&self.description).map_err(|error| match error {
            VersionedFileError::Damaged { cause, .. } => wrong(cause),
            other => other.into(),
        })?;
        if let Some(description) = &described {
            description.check(&self.spec).map_err(wrong)?;
        }
        Ok(described)
    }

    /// Begins evaluation episode `number`.
    ///
    /// # Errors
    /// When the server has ended, refuses or does not answer, or a signal has arrived.
    pub fn begin_evaluation(&mut self, number: u64) -> anyhow::Result<EnvironmentResponse> {
        let asked = Instant::now();
        let begun = self.client.reset(
            &self.listener,
            ResetRequest::Evaluation {
                first: number,
                episodes: NonZeroU32::MIN,
            },
            || self.give_up(asked),
        );
        checked(begun, &mut self.program)?.map_or_else(|| self.unanswered(asked), Ok)
    }

    /// Steps every environment with its action.
    ///
    /// # Errors
    /// When the server has ended, refuses or does not answer, or a signal has arrived.
    pub fn step(&mut self, actions: &[f32]) -> anyhow::Result<EnvironmentResponse> {
        let asked = Instant::now();
        let stepped = self.client.step(&self.listener, actions, || self.give_up(asked));
        match checked(stepped, &mut self.program)?.map_or_else(|| self.unanswered(asked), Ok)? {
            StepResult::Taken(observed) => Ok(observed),
            StepResult::Lost => {
                // It has left shared memory and is about to end. The last lines it writes name the reason.
                self.program.wait(END_TIMEOUT);
                self.program.check()?;
                bail!("the environment server has lost its episodes")
            }
        }
    }

    /// Asks for a picture of the state that the next answer describes.
    ///
    /// # Errors
    /// When the last picture cannot be removed.
    pub fn ask_for_picture(&self) -> anyhow::Result<()> {
        self.pictures
            .as_deref()
            .map_or(Ok(()), frame::ask)
            .context("the environment server's picture cannot be removed")
    }

    /// The picture that was asked for last; `None` if the server has written none.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn picture(&self) -> anyhow::Result<Option<Written>> {
        let Some(file) = &self.pictures else { return Ok(None) };
        frame::read(file).context("the environment server's picture cannot be read")
    }

    /// Whether the wait for an answer has ended without an answer, because of the time limit or a signal. A new server
    /// would take as long.
    pub fn is_silent(&self) -> bool {
        self.silent.get()
    }

    /// Ends the wait for an answer after a signal or the time limit.
    fn give_up(&self, asked: Instant) {
        if self.interrupt.signal().is_some() || asked.elapsed() >= self.limit {
            self.silent.set(true);
            self.stop.request();
        }
    }

    fn unanswered<T>(&mut self, asked: Instant) -> anyhow::Result<T> {
        if let Some(signal) = self.interrupt.signal() {
            bail!("ended by {}", describe(signal));
        }
        if asked.elapsed() >= self.limit {
            bail!(
                "the environment server did not answer within {} s; {}",
                self.limit.as_secs(),
                how_to_give_more_time(self.limit)
            );
        }
        ended(&mut self.program)
    }
}

impl Drop for ExternalEnvironment {
    fn drop(&mut self) {
        self.program.shut_down();
    }
}

/// A server that has described itself, and what it is used with.
struct Opened {
    services: Services,
    client: EnvironmentClient,
    listener: Listener,
    spec: EnvironmentSpec,
    program: ChildProcess,
    stop: Stop,
}

fn open(
    domain: &Domain,
    launch: &LaunchSpec<'_>,
    environment: &EnvironmentConfig,
    interrupt: &Interrupt,
) -> anyhow::Result<Opened> {
    let Some(command) = launch.command(environment)? else {
        bail!("environment {} is not served by another program", environment.name);
    };
    std::fs::write(&launch.iceoryx2, domain.iox_config()?)
        .with_context(|| format!("cannot write {}", launch.iceoryx2.display()))?;
    let mut services = Services::new(domain)?;
    services.create_common(domain)?;
    services.create_environment(domain, launch.index)?;
    let listener = Listener::bind(domain, launch.client)?;
    let mut program = tied(&command)
        .and_then(|mut command| Ok(ChildProcess::start(&mut command, "environment server".into())?))
        .with_context(|| cannot_start(&command))?;
    let has_answered = Stop::default();
    let stop = stop_when_it_ends(&program, has_answered.clone(), environment)?;
    let described = spec(domain, launch.index, &listener, stop.clone(), || {
        if interrupt.signal().is_some() {
            stop.request();
        }
    });
    has_answered.request();
    let (spec, environments) = match checked(described, &mut program).map_err(with_advice)? {
        Some(described) => described,
        None => match interrupt.signal() {
            Some(signal) => bail!("ended by {}", describe(signal)),
            None => bail!(
                "{} did not describe itself within {} s; {}",
                environment.name,
                environment.start_seconds,
                how_to_give_more_time(environment.start_limit())
            ),
        },
    };
    let opened = EnvironmentClient::open(domain, launch.index, &spec, environments, stop.clone());
    let Some(client) = checked(opened.map_err(Exit::from), &mut program)? else {
        return ended(&mut program);
    };
    Ok(Opened {
        services,
        client,
        listener,
        spec,
        program,
        stop,
    })
}

fn how_to_give_more_time(limit: Duration) -> String {
    let longer = limit.as_secs().saturating_mul(5);
    format!(
        "if it needs more time, set environment.start_seconds={longer}: with --set for a run in training, in \
         config/used.toml for a finished one"
    )
}

/// The error that the program is about to end. The last lines it writes name the reason.
fn ended<T>(program: &mut ChildProcess) -> anyhow::Result<T> {
    program.wait(END_TIMEOUT);
    program.check()?;
    bail!("the environment server does not answer, and does not end")
}

/// Adds what to do if the server for Gymnasium is not installed.
fn with_advice(error: anyhow::Error) -> anyhow::Error {
    if error.to_string().contains("No module named shoal_gym") {
        return anyhow::anyhow!("{error}; install it as described in python/README.md: pip install ./python");
    }
    error
}

/// A stop that is requested when the program has ended, or has not answered within its limit. A slow start is reported.
fn stop_when_it_ends(
    program: &ChildProcess,
    has_answered: Stop,
    environment: &EnvironmentConfig,
) -> anyhow::Result<Stop> {
    let stop = Stop::default();
    let flag = stop.clone();
    let (name, limit) = (environment.name.clone(), environment.start_limit());
    let process = program.as_fd().try_clone_to_owned();
    let process = process.context("cannot watch the environment server")?;
    std::thread::Builder::new()
        .name("watch".into())
        .spawn(move || {
            let ended = |timeout| wait_for_any(&[process.as_fd()], timeout);
            let first = SLOW_START.min(limit);
            if !ended(first) && !has_answered.requested() && limit > first {
                say(format!(
                    "waiting for {name} to start, for at most {} s",
                    limit.as_secs()
                ));
            }
            if !ended(limit - first) && has_answered.requested() {
                while !ended(Duration::MAX) {}
            }
            flag.request();
        })
        .context("cannot watch the environment server")?;
    Ok(stop)
}

/// The result; `None` if the program has not answered within its limit. If the program has ended, that is the error.
fn checked<T>(result: Result<T, Exit<ChannelError>>, program: &mut ChildProcess) -> anyhow::Result<Option<T>> {
    result.map(Some).or_else(|exit| {
        program.check()?;
        match exit {
            Exit::Stopped => Ok(None),
            Exit::Failed(error) => match (error.fault(), program.last_line()) {
                // Its last line describes the fault.
                (Some(ResponseFault::Reported), Some(line)) => bail!("{line}"),
                _ => Err(error.into()),
            },
        }
    })
}
