//! Environment servers that are other programs (`docs/PROTOCOL.md`): starting one, and using one outside a run to learn
//! its spaces or to evaluate a policy.

mod parameters;
pub mod server_location;

use std::cell::Cell;
use std::os::fd::AsFd;
use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{Command, ExitCode, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, Signal, getpid, kill_process, pidfd_open};
use shoal_common::channel::environment::{
    EnvironmentClient, EnvironmentResponse, ResetRequest, ResponseFault, StepResult, describe,
};
use shoal_common::channel::{ChannelError, Domain, EventName, Listener, Services};
use shoal_common::config::EnvironmentConfig;
use shoal_common::exit::Exit;
use shoal_common::message::say;
use shoal_common::role::Role;
use shoal_common::space::EnvironmentSpec;
use shoal_common::stop::{GRACE, Stop, kill_this_group};
use shoal_common::versioned_file::{VersionedFile, VersionedFileError};
use shoal_env_server::description::{self, Description};
use shoal_env_server::frame::{self, Written};

use crate::child_process::{ChildProcess, tied, wait_for_any};
use crate::external_environment::server_location::LaunchContext;
use crate::signals::{Interrupt, describe as describe_signal};

/// The prefix of the names of Gymnasium environments.
pub const GYMNASIUM: &str = "gym:";

/// How long a program may take to end after it has left shared memory.
const END_TIMEOUT: Duration = Duration::from_secs(2);

/// From this variable numeric libraries (OpenBLAS, MKL, PyTorch) read how many threads each of their processes uses.
const COMPUTE_THREADS: &str = "OMP_NUM_THREADS";

/// A start that takes longer is reported to the user.
const SLOW_START: Duration = Duration::from_secs(10);

/// The default command that serves environments of this name; `None` for built-in environments.
pub fn default_command(name: &str) -> Option<Vec<String>> {
    let gymnasium = || ["python3", "-m", "shoal_gym"].map(Into::into).into();
    name.starts_with(GYMNASIUM).then(gymnasium)
}

/// The file with which other programs find the run `run_id` in shared memory. It is removed with the run's files there.
///
/// # Errors
/// When the user's directory cannot be used.
pub fn server_iceoryx2_config(run_id: &str) -> anyhow::Result<PathBuf> {
    Ok(Domain::directory_of(run_id)?.join("config/iceoryx2.toml"))
}

/// The arguments of an environment server.
pub struct LaunchSpec<'a> {
    /// The iceoryx2 configuration file of the run's shared memory.
    pub iceoryx2: PathBuf,
    /// The run's id.
    pub run_id: &'a str,
    /// The index of the server in the run.
    pub index: u32,
    /// The number of this process among all that the run has started.
    pub incarnation: u64,
    /// The process that sends it requests.
    pub client: EventName,
    /// Number of environments that it steps together.
    pub environments: u32,
    /// The root of its random streams.
    pub seed: u64,
    /// With seed and index, selects the random streams of its training episodes.
    pub stream: u64,
    /// Where it is started, and with what.
    pub launch_context: LaunchContext,
    /// The file into which it is asked to write pictures, and their greatest height in pixels.
    pub pictures: Option<(PathBuf, u32)>,
    /// The file into which it is asked to write what its numbers mean.
    pub description: Option<PathBuf>,
}

impl LaunchSpec<'_> {
    /// The command that starts the server; `None` for a built-in environment.
    ///
    /// Numeric libraries in it use one thread unless the user's environment says otherwise: by default each server would
    /// use all cores, and results may depend on their number.
    pub fn command(&self, environment: &EnvironmentConfig) -> anyhow::Result<Option<Command>> {
        let Some((program, arguments)) = environment.server.split_first() else {
            return Ok(None);
        };
        let LaunchContext {
            location, hash_seed, ..
        } = &self.launch_context;
        let mut command = match location {
            Some(location) => {
                let mut command = Command::new(location.program());
                command.current_dir(location.directory());
                command
            }
            None => Command::new(program),
        };
        if let Some(seed) = hash_seed {
            command.env("PYTHONHASHSEED", seed.to_string());
        }
        if std::env::var_os(COMPUTE_THREADS).is_none() {
            command.env(COMPUTE_THREADS, "1");
        }
        match &self.pictures {
            Some((file, height)) => command
                .env(frame::FILE_VARIABLE, file)
                .env(frame::HEIGHT_VARIABLE, height.to_string()),
            None => command.env_remove(frame::FILE_VARIABLE),
        };
        match &self.description {
            Some(file) => command.env(description::FILE_VARIABLE, file),
            None => command.env_remove(description::FILE_VARIABLE),
        };
        command
            .args(arguments)
            .arg("--iceoryx2")
            .arg(&self.iceoryx2)
            .args(["--run", self.run_id])
            .args(["--index", &self.index.to_string()])
            .args(["--incarnation", &self.incarnation.to_string()])
            .args(["--client", &format!("{}/{}", self.client.0.name(), self.client.1)])
            .args(["--environments", &self.environments.to_string()])
            .args(["--seed", &self.seed.to_string()])
            .args(["--stream", &self.stream.to_string()])
            .args(["--name", &environment.name])
            .args(["--parameters", &parameters::json(&environment.parameters)?]);
        Ok(Some(command))
    }
}

/// Serves as the role by running the program, and ends as it ends. The program inherits this process's standard input
/// and standard error. If it has not ended [`GRACE`] after its standard input closed, this kills the process group, so
/// that a program that is stuck does not outlive its run.
///
/// # Errors
/// When the program cannot be started or watched.
pub fn serve_with(program: &Command) -> anyhow::Result<ExitCode> {
    let mut command = tied(program).with_context(|| cannot_start(program))?;
    let mut child = command
        .stdout(Stdio::null())
        .spawn()
        .with_context(|| cannot_start(program))?;
    let process =
        pidfd_open(Pid::from_child(&child), PidfdFlags::empty()).context("cannot watch the environment server")?;
    // No events: poll reports a closed stream anyway, and any input is for the program.
    let stdin = std::io::stdin();
    let mut until = [
        PollFd::new(&process, PollFlags::IN),
        PollFd::new(&stdin, PollFlags::empty()),
    ];
    while until.iter().all(|event| event.revents().is_empty()) {
        match poll(&mut until, None) {
            Ok(_) | Err(Errno::INTR) => {}
            Err(cause) => return Err(anyhow::Error::from(cause).context("cannot watch the environment server")),
        }
    }
    let deadline = Instant::now() + GRACE;
    loop {
        let left = deadline.saturating_duration_since(Instant::now());
        let left = Timespec::try_from(left).context("the time limit is too long")?;
        match poll(&mut [PollFd::new(&process, PollFlags::IN)], Some(&left)) {
            Ok(0) => kill_this_group(),
            Ok(_) => return end_as(child.wait()?),
            Err(Errno::INTR) => {}
            Err(cause) => return Err(anyhow::Error::from(cause).context("cannot watch the environment server")),
        }
    }
}

/// Ends this process with the same signal or exit code as another.
fn end_as(status: ExitStatus) -> anyhow::Result<ExitCode> {
    if let Some(signal) = status.signal().and_then(Signal::from_named_raw) {
        kill_process(getpid(), signal)?;
    }
    Ok(status
        .code()
        .and_then(|code| u8::try_from(code).ok())
        .map_or(ExitCode::FAILURE, ExitCode::from))
}

fn cannot_start(command: &Command) -> String {
    format!(
        "cannot start the environment server {}",
        command.get_program().display()
    )
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
    /// Starts the environment's server with this number of environments and asks for their description. `seed`
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
            Ok((services, client, listener, spec, program, stop)) => Ok(Self {
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
                episodes: 1,
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
            bail!("ended by {}", describe_signal(signal));
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

type Opened = (
    Services,
    EnvironmentClient,
    Listener,
    EnvironmentSpec,
    ChildProcess,
    Stop,
);

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
    let described = describe(domain, launch.index, &listener, stop.clone(), || {
        if interrupt.signal().is_some() {
            stop.request();
        }
    });
    has_answered.request();
    let (spec, environments) = match checked(described, &mut program).map_err(with_advice)? {
        Some(described) => described,
        None => match interrupt.signal() {
            Some(signal) => bail!("ended by {}", describe_signal(signal)),
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
    Ok((services, client, listener, spec, program, stop))
}

fn how_to_give_more_time(limit: Duration) -> String {
    let longer = limit.as_secs().saturating_mul(5);
    format!(
        "if it needs more: environment.start_seconds={longer}, with --set for a run that is trained, in config/used.toml of \
         one that is finished"
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
