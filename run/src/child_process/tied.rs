//! Programs that are killed when this process dies, even by SIGKILL.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};

use anyhow::{Context, bail};
use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal};

/// The hidden command that replaces itself by another program, which is killed when its parent process dies.
const TIED_COMMAND: &str = "tied";

/// The command that starts `program` tied to this process: it is killed whenever this process dies.
///
/// # Errors
/// When there is no such program. The error does not name it.
pub fn tied(program: &Command) -> anyhow::Result<Command> {
    let name = Path::new(program.get_program());
    let in_path = || {
        let path = std::env::var_os("PATH").unwrap_or_default();
        std::env::split_paths(&path).any(|directory| directory.join(name).is_file())
    };
    if !name.is_file() && (name.components().count() > 1 || !in_path()) {
        bail!("there is no such file");
    }
    let mut command = Command::new("/proc/self/exe");
    command
        .arg0("shoal")
        .args([TIED_COMMAND, &std::process::id().to_string()]);
    command.arg(program.get_program()).args(program.get_args());
    if let Some(directory) = program.get_current_dir() {
        command.current_dir(directory);
    }
    for (name, value) in program.get_envs() {
        match value {
            Some(value) => command.env(name, value),
            None => command.env_remove(name),
        };
    }
    Ok(command)
}

/// Carries out the hidden command `tied`: ties this process to `parent` and replaces it by the program. Returns only on errors.
///
/// # Errors
/// When the program cannot be started.
pub fn exec_tied(parent: u32, command_line: &[OsString]) -> anyhow::Result<ExitCode> {
    let Some((program, arguments)) = command_line.split_first() else {
        bail!("there is no program to start");
    };
    tie_to_parent(parent)?;
    let cause = Command::new(program).args(arguments).exec();
    Err(anyhow::Error::from(cause).context(format!("cannot start {}", program.display())))
}

/// Ties this process to its parent process, whose id is `parent`: it is killed when the parent dies.
///
/// # Errors
/// When the parent has died already.
pub fn tie_to_parent(parent: u32) -> anyhow::Result<()> {
    set_parent_process_death_signal(Some(Signal::KILL)).context("cannot tie this process to its parent process")?;
    // It may have died before it was tied to.
    if getppid().map(Pid::as_raw_pid) != Some(parent as i32) {
        bail!("the parent process has ended");
    }
    Ok(())
}
