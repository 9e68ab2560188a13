//! Whether the machine has room for a run, before anything is started: shared memory, disk and open files. Later a lack of
//! them is a SIGBUS, or the end of some role in the middle of its work.

mod needs;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use shoal_common::channel::{Domain, free_shared_memory};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

/// Whether there is room for the run in this directory, which need not be there yet; nothing is made. What this user's
/// killed runs left in shared memory is removed, and this process may open as many files as the system lets it.
///
/// # Errors
/// When there is no room: what is needed, what there is, and what to do.
pub fn check(config: &Config, run: &RunDir) -> anyhow::Result<()> {
    Domain::remove_abandoned()?;
    check_open_files(config)?;
    check_disk(config, run)?;
    check_shared_memory(config)
}

/// The same for a run that has joined its corner of shared memory, where its needs are noted first: of two runs that are
/// started at once, each sees the other's.
///
/// # Errors
/// As for [`check`].
pub fn claim(config: &Config, run: &RunDir, domain: &Domain) -> anyhow::Result<()> {
    domain.promise(needs::shared_memory(config))?;
    check(config, run)
}

fn check_shared_memory(config: &Config) -> anyhow::Result<()> {
    let need = needs::shared_memory(config);
    let free = free_shared_memory(&config.run.id).context("cannot ask how much of /dev/shm is free")?;
    let Some(free) = free.filter(|free| *free < need) else {
        return Ok(());
    };
    let mut smaller = config.clone();
    let fits = (1..config.actors.max).rev().find(|max| {
        smaller.actors.max = *max;
        needs::shared_memory(&smaller) <= free
    });
    let advice = match fits {
        Some(max) => format!("lay it out for at most {max} (--set actors.max={max})"),
        None => "choose smaller networks (ddpg.hidden) or chunks (actors.chunk_steps)".into(),
    };
    bail!(
        "the run needs {} of /dev/shm for up to {} actors, and {} are free: {advice}, end other runs, or make it larger \
         (mount -o remount,size=… /dev/shm, or docker run --shm-size=…)",
        mebibytes(need),
        config.actors.max,
        mebibytes(free)
    );
}

fn check_disk(config: &Config, run: &RunDir) -> anyhow::Result<()> {
    let place = existing(run.path());
    let need = needs::disk(config, run)?;
    let status =
        rustix::fs::statvfs(&place).with_context(|| format!("cannot ask how much room {} has", place.display()))?;
    let free = status.f_bavail * status.f_frsize;
    // A file system without blocks of its own does not say.
    if status.f_blocks > 0 && free < need {
        bail!(
            "the run needs {} of disk and {} has {}: choose another place with --run, free some space, or remember less \
             (replay.capacity = {})",
            mebibytes(need),
            place.display(),
            mebibytes(free),
            config.replay.capacity
        );
    }
    Ok(())
}

/// Raises the limit as far as it goes; the roles inherit it.
fn check_open_files(config: &Config) -> anyhow::Result<()> {
    let need = needs::open_files(config);
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current.is_some_and(|current| maximum.is_none_or(|maximum| current < maximum)) {
        let raised = Rlimit {
            current: maximum,
            maximum,
        };
        setrlimit(Resource::Nofile, raised).context("cannot raise the limit of open files")?;
    }
    match maximum {
        Some(limit) if limit < need => bail!(
            "the run needs {need} open files in one process for up to {} actors, and the limit is {limit}: raise it \
             (ulimit -Hn {need}) or lower actors.max",
            config.actors.max
        ),
        _ => Ok(()),
    }
}

/// The nearest directory above `path` that is there.
fn existing(path: &Path) -> PathBuf {
    let found = path.ancestors().find(|path| path.exists());
    found
        .filter(|path| !path.as_os_str().is_empty())
        .unwrap_or(Path::new("."))
        .into()
}

/// With one decimal, as people and `df -h` count.
fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}
