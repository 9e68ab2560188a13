//! Checks that the machine has enough shared memory, disk space and open files for a run, before anything is started.
//! A shortage found later is a SIGBUS, or ends a role in the middle of its work.

mod needs;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use shoal_common::channel::{Domain, free_shared_memory};
use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;

use crate::numbers::mebibytes;

/// Checks that the machine has the resources for this run. The run directory need not exist; nothing is created.
/// Removes what this user's killed runs left in shared memory, and raises this process's limit on open files to its
/// maximum.
///
/// # Errors
/// When a resource is short: what is needed, what is available, and what to do.
pub fn check(config: &Config, run: &RunDir) -> anyhow::Result<()> {
    Domain::remove_abandoned()?;
    check_open_files(config)?;
    check_disk(config, run)?;
    check_shared_memory(config)
}

/// Like [`check`], for a run that has joined its domain. Records the run's needs there first, so that two runs started
/// at the same time see each other's.
///
/// # Errors
/// As for [`check`].
pub fn reserve(config: &Config, run: &RunDir, domain: &Domain) -> anyhow::Result<()> {
    domain.reserve_memory(needs::shared_memory(config))?;
    check(config, run)
}

/// How many runs of this configuration the free shared memory allows side by side.
///
/// # Errors
/// When the amount cannot be found out.
pub fn side_by_side(config: &Config) -> anyhow::Result<usize> {
    let need = needs::shared_memory(config).max(1);
    let free = free_shared_memory(&config.run.id).context("cannot find out how much of /dev/shm is free")?;
    Ok(free.map_or(usize::MAX, |free| (free / need) as usize))
}

/// Like [`reserve`], for a host that joins a run: it has no replay.
///
/// # Errors
/// When shared memory or open files are short.
pub fn reserve_for_host(config: &Config, domain: &Domain) -> anyhow::Result<()> {
    domain.reserve_memory(needs::shared_memory(config))?;
    Domain::remove_abandoned()?;
    check_open_files(config)?;
    check_shared_memory(config)
}

fn check_shared_memory(config: &Config) -> anyhow::Result<()> {
    let need = needs::shared_memory(config);
    let free = free_shared_memory(&config.run.id).context("cannot find out how much of /dev/shm is free")?;
    let Some(free) = free.filter(|free| *free < need) else {
        return Ok(());
    };
    let mut smaller = config.clone();
    let fits = (1..config.actors.max).rev().find(|max| {
        smaller.actors.max = *max;
        needs::shared_memory(&smaller) <= free
    });
    let advice = match fits {
        Some(max) if max < config.actors.count => {
            format!("allow at most {max} actors (--actors {max} --set actors.max={max})")
        }
        Some(max) => format!("allow at most {max} actors (--set actors.max={max})"),
        None => format!(
            "choose smaller networks ({}.hidden), shorter chunks (actors.chunk_steps) or fewer environments per actor \
             (actors.envs)",
            config.algorithm.name()
        ),
    };
    bail!(
        "the run needs {} of /dev/shm for up to {} actors, but only {} are free: {advice}, end other runs, or enlarge \
         it (mount -o remount,size=… /dev/shm, or docker run --shm-size=…)",
        mebibytes(need),
        config.actors.max,
        mebibytes(free)
    );
}

fn check_disk(config: &Config, run: &RunDir) -> anyhow::Result<()> {
    let place = existing(run.path());
    let need = needs::disk(config, run)?;
    let status = rustix::fs::statvfs(&place)
        .with_context(|| format!("cannot find out how much space {} has", place.display()))?;
    let free = status.f_bavail * status.f_frsize;
    // A file system without blocks of its own reports 0.
    if status.f_blocks > 0 && free < need {
        bail!(
            "the run needs {} of disk and {} has {}: choose another directory with --run, free some space, or lower \
             replay.capacity (= {})",
            mebibytes(need),
            place.display(),
            mebibytes(free),
            config.replay.capacity
        );
    }
    Ok(())
}

/// Raises the limit to its maximum; the roles inherit it.
fn check_open_files(config: &Config) -> anyhow::Result<()> {
    let need = needs::open_files(config);
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    if current.is_some_and(|current| maximum.is_none_or(|maximum| current < maximum)) {
        let raised = Rlimit {
            current: maximum,
            maximum,
        };
        setrlimit(Resource::Nofile, raised).context("cannot raise the limit on open files")?;
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

/// `path` or its nearest ancestor that exists.
fn existing(path: &Path) -> PathBuf {
    let found = path.ancestors().find(|path| path.exists());
    found
        .filter(|path| !path.as_os_str().is_empty())
        .unwrap_or(Path::new("."))
        .into()
}
