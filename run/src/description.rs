//! The meaning of the numbers of an environment, by its configuration.

use shoal_common::config::Config;
use shoal_common::run_dir::RunDir;
use shoal_common::versioned_file::VersionedFile;
use shoal_env_server::description::Description;
use shoal_env_server::environment::make;

/// Describes the environment of this configuration. If another program serves it, only the positions of its numbers are
/// known.
///
/// # Errors
/// When the environment cannot be created from the configuration.
pub fn of(config: &Config) -> anyhow::Result<Description> {
    if config.environment.is_external() {
        return Ok(Description::by_number(&config.spec));
    }
    let environment = make(&config.environment.name, &config.environment.parameters)?;
    Ok(Description::of(&*environment))
}

/// As [`of`], for a run, whose directory keeps the description that the environment's program has given.
///
/// # Errors
/// As for [`of`], and when `description.json` cannot be read or does not fit the run's spaces.
pub fn of_run(run: &RunDir, config: &Config) -> anyhow::Result<Description> {
    match kept(run, config)? {
        Some(kept) => Ok(kept),
        None => of(config),
    }
}

/// What the program that serves the run's environment has said; `None` if the environment is built in, or the program
/// says nothing.
///
/// # Errors
/// As for [`of_run`].
pub fn kept(run: &RunDir, config: &Config) -> anyhow::Result<Option<Description>> {
    if !config.environment.is_external() {
        return Ok(None);
    }
    let file = run.description();
    let kept = Description::load_if_any(&file)?;
    if let Some(kept) = &kept {
        kept.check(&config.spec)
            .map_err(|what| anyhow::anyhow!("{}: {what}{}", file.display(), Description::IF_DAMAGED))?;
    }
    Ok(kept)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::small;
    use shoal_env_server::environment::{Picture, Signal};

    #[test]
    fn an_external_environment_is_described_by_position_even_under_a_builtin_name() {
        let (mut config, _) = small("name = \"point-mass\"\nreward = \"r1\"");
        let ours = of(&config).unwrap();
        assert!(ours.goal.is_some() && ours.picture == Picture::Plane && ours.signals[0].key == "x");
        config.environment.server = vec!["some-program".into()];
        let theirs = of(&config).unwrap();
        assert_eq!(
            (theirs.goal, theirs.picture, theirs.time_step),
            (None, Picture::None, None)
        );
        let keys: Vec<_> = theirs.signals.iter().map(|signal| signal.key.as_str()).collect();
        assert_eq!((keys.len(), keys[0], keys[7]), (8, "observation-1", "action-2"));
    }

    #[test]
    fn a_run_keeps_what_its_server_has_said() {
        let parent = tempfile::tempdir().unwrap();
        let run = RunDir::create(&parent.path().join("run")).unwrap();
        let (mut config, _) = small("name = \"pendulum\"");
        let mut said = Description::by_number(&config.spec);
        said.signals = vec![Signal::observation(2, "speed", "rad/s")];
        said.store(&run.description()).unwrap();
        assert_eq!(of_run(&run, &config).unwrap(), of(&config).unwrap(), "it is built in");
        config.environment.server = vec!["some-program".into()];
        assert_eq!(of_run(&run, &config).unwrap(), said);
        said.signals[0] = Signal::observation(3, "speed", "rad/s");
        said.store(&run.description()).unwrap();
        let refused = of_run(&run, &config).unwrap_err().to_string();
        assert!(
            refused.contains("description.json") && refused.contains("delete it") && !refused.contains('\n'),
            "{refused}"
        );
        std::fs::remove_file(run.description()).unwrap();
        assert_eq!(of_run(&run, &config).unwrap(), of(&config).unwrap(), "an old run");
    }
}
