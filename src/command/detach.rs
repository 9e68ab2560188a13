//! `--detach`, of `train` and `resume`: what was started outlives its terminal.

use std::ffi::{OsStr, OsString};
use std::fs::File;
use std::io::Write;
use std::os::unix::fs::FileExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use serde::Serialize;
use shoal_common::file_lock;
use shoal_common::message::say;
use shoal_common::run_dir::RunDir;
use shoal_run::client::{RunClient, is_in_final_evaluation};
use shoal_run::suite::{self, Suite};

use super::training::OutputOptions;

/// The hidden command that begins a session without a terminal, and then executes this program with the given
/// arguments.
pub(crate) const COMMAND: &str = "in-new-session";

/// How long the start may take, beside what the environment is allowed (`environment.start_seconds`).
const TIMEOUT: Duration = Duration::from_secs(60);

/// How long a second launcher, which is refused because one is running, may take to end.
const REFUSED_END_TIMEOUT: Duration = Duration::from_secs(5);

/// Pause between two looks at a run that starts.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// The output of `--json`.
#[derive(Serialize)]
struct DetachedJson<'a> {
    run: &'a Path,
    /// The process id of the launcher.
    pid: u32,
}

/// Resumes a run with these further arguments in a session of its own. Returns when all its actors work.
///
/// # Errors
/// When the run is running already, or does not start in time.
pub(crate) fn resume_run(path: &Path, arguments: &[OsString], output: &OutputOptions) -> anyhow::Result<ExitCode> {
    // A run that is running already is refused here. Later its launcher would look like the new one.
    drop(RunDir::open(path)?.lock()?);
    let of_environment = RunClient::open(path)?.config.environment.start_seconds;
    let timeout = TIMEOUT + Duration::from_secs(of_environment.into());
    let is_at_work = || {
        let status = RunClient::open(path)?.status()?;
        let works = status.is_some_and(|status| status.all_actors_work() || is_in_final_evaluation(&status));
        Ok(works && RunDir::open(path)?.replay_file().exists())
    };
    let how_to_end = |path: &str, _| format!("look: shoal top {path}; end: shoal stop {path}");
    start_detached(path, (arguments, timeout), output, is_at_work, how_to_end)
}

/// As [`resume_run`] for a suite. Returns when a process trains one of its runs, or has worked on it for a while.
///
/// # Errors
/// When a process works on it already, or the new one does not begin in time.
pub(crate) fn resume_suite(path: &Path, arguments: &[OsString], output: &OutputOptions) -> anyhow::Result<ExitCode> {
    drop(suite::lock(path)?);
    let begun = Instant::now();
    let is_at_work = || {
        let trials = Suite::read(path)?.map(|suite| suite.runs(path)).unwrap_or_default();
        let mut runs = trials.iter().filter_map(|run| RunDir::open(run).ok());
        // Before the first run begins, its environment is started twice, which may take minutes.
        let has_begun = runs.any(|run| run.is_running().unwrap_or(false)) || begun.elapsed() >= TIMEOUT;
        Ok(has_begun && file_lock::is_locked(&File::open(path)?)?)
    };
    let how_to_end = |path: &str, pid| format!("look: shoal list {path}; end: kill {pid}");
    let timeout = TIMEOUT + 2 * REFUSED_END_TIMEOUT;
    start_detached(path, (arguments, timeout), output, is_at_work, how_to_end)
}

fn start_detached(
    path: &Path,
    (arguments, timeout): (&[OsString], Duration),
    output: &OutputOptions,
    is_at_work: impl Fn() -> anyhow::Result<bool>,
    how_to_end: impl Fn(&str, u32) -> String,
) -> anyhow::Result<ExitCode> {
    let path = std::path::absolute(path).with_context(|| format!("cannot resolve {}", path.display()))?;
    let here = path.display();
    let messages = tempfile::tempfile().context("cannot make a temporary file")?;
    let mut command = Command::new("/proc/self/exe");
    command.arg0("shoal").arg(COMMAND).args(["resume", "--quiet"]);
    command.args(arguments).arg("--").arg(&path);
    command
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(messages.try_clone()?);
    let mut child = command.spawn().context("cannot start the launcher")?;
    // Another process may have been started at the same time. Of the two, one is refused and ends.
    let pid = child.id();
    let is_by_child = |since: &mut Option<Instant>| {
        let since = *since.get_or_insert_with(Instant::now);
        let holders = path.metadata().map(|directory| file_lock::holders(&directory));
        holders.is_ok_and(|holders| holders.contains(&(pid as i32))) || since.elapsed() >= REFUSED_END_TIMEOUT
    };
    let begun = Instant::now();
    let mut is_over = false;
    // While it starts, a launcher may be unable to answer.
    let mut at_work_since = None;
    while !(is_at_work().unwrap_or(false) && is_by_child(&mut at_work_since)) {
        if let Some(status) = child.try_wait()? {
            if status.success() {
                is_over = true;
                break;
            }
            write_messages(&messages)?;
            let code = status.code().and_then(|code| u8::try_from(code).ok());
            return Ok(code.map_or(ExitCode::FAILURE, ExitCode::from));
        }
        if begun.elapsed() >= timeout {
            write_messages(&messages)?;
            end(child);
            bail!(
                "{here} did not start within {} s and is being stopped; see shoal.log in that directory",
                timeout.as_secs()
            );
        }
        std::thread::sleep(POLL_INTERVAL);
    }
    write_messages(&messages)?;
    if !output.quiet {
        let what = match is_over {
            true => "is over already".into(),
            false => format!(
                "runs by itself, as process {pid}; {}",
                how_to_end(&here.to_string(), pid)
            ),
        };
        say(format!("{here} {what}"));
    }
    if output.json {
        let printed = serde_json::to_string(&DetachedJson { run: &path, pid })?;
        writeln!(std::io::stdout(), "{printed}")?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Asks the launcher to end in order.
fn end(child: Child) {
    if let Some(pid) = rustix::process::Pid::from_raw(child.id() as i32) {
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
    }
}

/// Shows what the launcher has written so far: warnings, how to join, or its error.
fn write_messages(messages: &File) -> anyhow::Result<()> {
    let (mut text, mut part) = (Vec::new(), [0; 4096]);
    // The launcher writes at the offset of this file, so reading must not move it.
    loop {
        match messages.read_at(&mut part, text.len() as u64)? {
            0 => break,
            read => text.extend_from_slice(&part[..read]),
        }
    }
    // As in `say`.
    let _ = std::io::stderr().write_all(&text);
    Ok(())
}

/// Carries out [`COMMAND`]. Returns only on errors.
pub(crate) fn exec_in_new_session(arguments: &[OsString]) -> anyhow::Result<ExitCode> {
    rustix::process::setsid().context("cannot begin a session")?;
    let mut command = Command::new("/proc/self/exe");
    Err(command.arg0(OsStr::new("shoal")).args(arguments).exec().into())
}
