//! The directory of a joined host.

use std::path::Path;

use anyhow::{Context, bail};
use shoal_common::config::Config;
use shoal_common::run_dir::{LockedRun, RunDir};

use crate::external_environment::ExternalEnvironment;
use crate::external_environment::server_location::{LaunchContext, ServerLocation};
use crate::signals::Interrupt;

/// Makes the directory at `path` from the run's configuration. The run's processes on this host find each other under a
/// name of their own, so a host may join a run of the same machine. `first_incarnation` is the first incarnation that
/// they may have.
///
/// # Errors
/// When the directory exists, the configuration cannot be used here, or an environment that another program serves has
/// other spaces here.
pub fn make_host_directory(
    path: &Path,
    configuration: &str,
    first_incarnation: u64,
    interrupt: Interrupt,
) -> anyhow::Result<(Config, LockedRun)> {
    let run = RunDir::create(path)?.lock()?;
    let made = fill(&run, configuration, first_incarnation, interrupt);
    match made {
        Ok(config) => Ok((config, run)),
        Err(error) => {
            let _ = std::fs::remove_dir_all(run.path());
            Err(error)
        }
    }
}

fn fill(run: &RunDir, configuration: &str, first_incarnation: u64, interrupt: Interrupt) -> anyhow::Result<Config> {
    let cannot_write = |path: &Path| format!("cannot write {}", path.display());
    let config_file = run.config_file();
    std::fs::write(&config_file, configuration).with_context(|| cannot_write(&config_file))?;
    let mut config = run
        .config()
        .context("the run's configuration cannot be used on this host")?;
    config.run.id = format!("{:08x}", rand::random::<u32>());
    run.write_config(&config)?;
    let incarnations = run.incarnations();
    std::fs::write(&incarnations, (first_incarnation - 1).to_string()).with_context(|| cannot_write(&incarnations))?;
    if let Some(location) = ServerLocation::here(&config.environment.server)? {
        location.write(run)?;
        let launch_context = LaunchContext::of_run(run, &config)?;
        let environment = ExternalEnvironment::begin_in(&config.environment, 1, 0, launch_context, interrupt)?;
        let found = environment.spec();
        if found.difference(&config.spec).is_some() {
            bail!(
                "the environment {} has other spaces on this host: {found:?} instead of {:?}",
                config.environment.name,
                config.spec
            );
        }
    }
    Ok(config)
}
