//! The plan of a new run: presets, files and overrides become one resolved configuration, and its directory is created.
//! No later code reads options that change it.

pub mod algorithm;
mod environment;
mod overrides;
mod presets;
mod resolve;
mod revision;
mod sections;
mod source;
mod suggestion;
mod table;

use std::path::Path;

use shoal_common::config::Config;
use shoal_common::run_dir::{LockedRun, RunDir};
use shoal_common::versioned_file::VersionedFile;
use shoal_env_server::description::Description;

pub use self::overrides::RunOverrides;
pub use self::presets::{preset_names, preset_patterns};
pub(crate) use self::resolve::resolve_interruptibly;
use self::resolve::{Resolved, resolve_all};
pub use self::resolve::{resolve, resolve_preset, resolve_with_sources};
use self::revision::as_written;
pub use self::revision::{RequestedChanges, Revision, edited, store_actors};
pub use self::sections::is_configuration_file;
pub use self::source::{SettingSource, SettingSources};

use crate::demonstrations::Demonstrations;
use crate::external_environment::server_location::ServerLocation;
use crate::origin::{Origin, PendingOrigin, SourceRun};
use crate::preflight;
use crate::records::start::StartRecord;
use crate::signals::Interrupt;

/// A warning, if one is needed, before a run of this configuration starts or continues.
pub fn warning(config: &Config) -> Option<String> {
    let (steps, warmup) = (config.run.steps, config.replay.warmup);
    (steps <= warmup && config.replay.updates_per_step > 0.0).then(|| {
        format!(
            "nothing will be learned: the first update comes after the warm-up of {warmup} steps, and the run has {steps}; \
             give it more with --steps, or lower replay.warmup"
        )
    })
}

/// A run that is ready to start.
#[derive(Debug)]
pub struct Plan {
    /// Its resolved configuration.
    pub config: Config,
    /// Its directory. This process owns the run until this is dropped.
    pub run: LockedRun,
    /// The run or dataset that it begins with, if any.
    pub origin: Option<Origin>,
    /// What is worth a warning before it starts.
    pub warnings: Vec<String>,
}

impl Plan {
    /// Resolves and checks the configuration, then creates the run directory with its `config.toml`.
    ///
    /// # Errors
    /// When the configuration is invalid, the machine lacks resources, or the directory cannot be created. No run
    /// directory remains.
    pub fn new(what: &str, overrides: &RunOverrides) -> anyhow::Result<Self> {
        let Resolved {
            name,
            mut config,
            description,
            ..
        } = resolve_all(what, overrides, Interrupt::default())?;
        let pending_origin = match (&overrides.from, &overrides.demonstrations) {
            (Some(from), _) => {
                let source = SourceRun::open(from, overrides.with_replay)?;
                Some(PendingOrigin::Run(Box::new(source)))
            }
            (None, Some(dataset)) => Some(PendingOrigin::Dataset(Demonstrations::read(dataset, &config)?)),
            (None, None) => None,
        };
        if let Some(pending) = &pending_origin {
            pending.prepare(&mut config)?;
        }
        let place = overrides.run.clone().unwrap_or_else(|| Path::new("runs").join(&name));
        preflight::check(&config, &RunDir::at(&place))?;
        let run = match &overrides.run {
            Some(path) => RunDir::create(path)?,
            None => RunDir::create_next(Path::new("runs"), &name)?,
        };
        let begin = || {
            let locked = run.lock()?;
            let config = fill(&run, &config, description.as_ref())?;
            StartRecord::of_this_process().write(run.path())?;
            let origin = pending_origin.as_ref().map(|pending| pending.write(&run, &config));
            Ok((locked, config, origin.transpose()?))
        };
        let (locked, config, origin) = begin().inspect_err(|_: &anyhow::Error| {
            // The directory would block the next attempt.
            let _ = run.remove();
        })?;
        let of_rows = pending_origin.and_then(|pending| pending.warning(&config));
        Ok(Self {
            warnings: warning(&config).into_iter().chain(of_rows).collect(),
            config,
            run: locked,
            origin,
        })
    }
}

/// Writes the first files of a new run directory. Returns the configuration as the roles will read it: writing changes
/// it (a date among the environment's parameters becomes a string), and all processes must compute the same identity.
fn fill(run: &RunDir, config: &Config, description: Option<&Description>) -> anyhow::Result<Config> {
    if let Some(location) = ServerLocation::here(&config.environment.server)? {
        location.write(run)?;
    }
    if let Some(description) = description {
        description.store(&run.description())?;
    }
    run.write_config(&as_written(config))?;
    let mut read = run.config()?;
    // `config.toml` does not have these two keys.
    (read.replay.ratio_since, read.replay.updates_before) = (config.replay.ratio_since, config.replay.updates_before);
    run.write_used_config(&read)?;
    Ok(read)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_new_run_has_the_identity_that_its_directory_has() {
        let parent = tempfile::tempdir().unwrap();
        let run = RunDir::create(&parent.path().join("run")).unwrap();
        let mut config = resolve_preset("pendulum").unwrap();
        // Parameters that other programs may take.
        let parameters = "day = 1979-05-27\nx = [nan, -inf, 1e300]\n[parameters]\nname = \"x\"";
        config.environment.parameters = parameters.parse().unwrap();
        let filled = fill(&run, &config, None).unwrap();
        let read = run.config().unwrap();
        assert_eq!(filled.identity(), read.identity());
        run.write_config(&read).unwrap();
        assert_eq!(
            filled.identity(),
            run.config().unwrap().identity(),
            "as resume and scale write it"
        );
    }
}
