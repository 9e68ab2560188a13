//! How a run launches an environment server: the server's arguments, and the role that runs its program.

use std::os::unix::process::ExitStatusExt;
use std::path::PathBuf;
use std::process::{Command, ExitCode, ExitStatus, Stdio};
use std::time::Instant;

use anyhow::Context;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, Signal, getpid, kill_process, pidfd_open};
use shoal_common::channel::{Domain, EventName};
use shoal_common::config::EnvironmentConfig;
use shoal_common::stop::{GRACE, kill_this_group};
use shoal_env_server::{description, frame};

use super::parameters;
use super::server_location::LaunchContext;
use crate::child_process::tied;

/// From this variable numeric libraries (OpenBLAS, MKL, PyTorch) read how many threads each of their processes uses.
const COMPUTE_THREADS: &str = "OMP_NUM_THREADS";

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
    /// With seed and index, selects the random streams of its training episodes: the incarnation, or 0 in lockstep.
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

pub(super) fn cannot_start(command: &Command) -> String {
    format!(
        "cannot start the environment server {}",
        command.get_program().display()
    )
}
