//! The configuration of a new run: presets, files and overrides become one resolved configuration. No later code reads
//! command-line options.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::de::DeserializeOwned;
use shoal_common::config::{ActorsConfig, Algorithm, Config, EnvironmentConfig, IdentityFormat, Mode, RunConfig};
use shoal_common::run_dir::{RunDir, RunLock};
use shoal_env_server::environment;
use toml::{Table, Value};

use crate::external_environment::{self, ExternalEnvironment, GYMNASIUM};
use crate::method;
use crate::preflight;
use crate::server_location::{ServerLocation, Surroundings, hash_seed};
use crate::signals::Interrupt;

const PRESETS: [(&str, &str); 15] = [
    ("pendulum", include_str!("../../presets/pendulum.toml")),
    ("point-mass-r1", include_str!("../../presets/point-mass-r1.toml")),
    ("point-mass-r2", include_str!("../../presets/point-mass-r2.toml")),
    ("point-mass-r3", include_str!("../../presets/point-mass-r3.toml")),
    ("frozen-lake", include_str!("../../presets/frozen-lake.toml")),
    (
        "frozen-lake-sarsa",
        include_str!("../../presets/frozen-lake-sarsa.toml"),
    ),
    ("cart-pole", include_str!("../../presets/cart-pole.toml")),
    // Those for another method than the thesis's have the name of their task and that of the method.
    ("pendulum-sac", include_str!("../../presets/pendulum-sac.toml")),
    ("pendulum-td3", include_str!("../../presets/pendulum-td3.toml")),
    (
        "point-mass-r1-sac",
        include_str!("../../presets/point-mass-r1-sac.toml"),
    ),
    (
        "point-mass-r1-td3",
        include_str!("../../presets/point-mass-r1-td3.toml"),
    ),
    (
        "point-mass-r2-sac",
        include_str!("../../presets/point-mass-r2-sac.toml"),
    ),
    (
        "point-mass-r2-td3",
        include_str!("../../presets/point-mass-r2-td3.toml"),
    ),
    (
        "point-mass-r3-sac",
        include_str!("../../presets/point-mass-r3-sac.toml"),
    ),
    (
        "point-mass-r3-td3",
        include_str!("../../presets/point-mass-r3-td3.toml"),
    ),
];

/// The keys that the program sets itself.
pub const FILLED_IN: [&str; 2] = ["run.id", "run.identity_format"];

/// The presets' names.
pub fn preset_names() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().map(|(name, _)| *name)
}

/// The resolved configuration of a preset or a file, without overrides.
pub fn resolved(what: &str) -> anyhow::Result<Config> {
    decide(what, &RunOverrides::default()).map(|(_, config)| config)
}

/// Changes to a preset or a file for one run.
#[derive(Clone, Debug, Default)]
pub struct RunOverrides {
    /// Run directory to create; by default `runs/<name>-<n>`.
    pub run: Option<PathBuf>,
    /// The method, by its name.
    pub method: Option<String>,
    /// `run.seed`.
    pub seed: Option<u64>,
    /// `actors.count`.
    pub actors: Option<u32>,
    /// `actors.envs`.
    pub envs: Option<u32>,
    /// `run.steps`.
    pub steps: Option<u64>,
    /// `run.episodes`.
    pub episodes: Option<u64>,
    /// Whether to set `run.mode` to lockstep.
    pub lockstep: bool,
    /// Any key, as `SECTION.KEY=VALUE`.
    pub set: Vec<String>,
}

/// A run that is ready to start.
#[derive(Debug)]
pub struct Plan {
    /// Its resolved configuration.
    pub config: Config,
    /// Its directory.
    pub run: RunDir,
    /// Held for as long as this process owns the run.
    pub lock: RunLock,
}

impl Plan {
    /// Resolves and checks the configuration, then creates the run directory with its `config.toml`.
    ///
    /// # Errors
    /// When the configuration is invalid, the machine lacks resources, or the directory cannot be created. No run
    /// directory remains.
    pub fn new(what: &str, overrides: &RunOverrides) -> anyhow::Result<Self> {
        let (name, config) = decide(what, overrides)?;
        let place = overrides.run.clone().unwrap_or_else(|| Path::new("runs").join(&name));
        preflight::check(&config, &RunDir::planned(&place))?;
        let run = match &overrides.run {
            Some(path) => RunDir::create(path)?,
            None => RunDir::create_next(Path::new("runs"), &name)?,
        };
        let lock = run.lock()?;
        let config = fill(&run, &config).inspect_err(|_| {
            // The directory would block the next attempt.
            let _ = std::fs::remove_dir_all(run.path());
        })?;
        Ok(Self { config, run, lock })
    }
}

/// Writes the first files of a new run directory and returns the configuration as the roles read it: a date among the
/// environment's parameters is a string there, and all processes must compute the same identity.
fn fill(run: &RunDir, config: &Config) -> anyhow::Result<Config> {
    if let Some(location) = ServerLocation::here(&config.environment.server)? {
        location.write(run)?;
    }
    run.write_config(config)?;
    Ok(run.config()?)
}

/// The configuration of a preset or a file with these overrides, and the default name of its run. Creates nothing.
pub fn decide(what: &str, overrides: &RunOverrides) -> anyhow::Result<(String, Config)> {
    let (mut name, mut table) = sections(what)?;
    if let Some(method) = method::asked_for(overrides.method.as_deref(), &overrides.set)? {
        let named = method::named_in(&table);
        if let Some((own, text)) = preset(&format!("{what}-{method}")) {
            (name, table) = (own.into(), text.parse().with_context(|| format!("preset {own}"))?);
        } else if preset(what).is_some() {
            if named.unwrap_or(Algorithm::default().name()) != method {
                method::replace(&mut table, method)?;
                name = format!("{name}-{method}");
            }
        } else if let Some(other) = named.filter(|named| *named != method) {
            bail!("{what} is for {other}, but {method} is asked for: remove what belongs to {other} from the file");
        } else {
            let environment = table.get("environment").and_then(|section| section.get("name"));
            let environment = environment.and_then(Value::as_str).unwrap_or_default().to_owned();
            method::add_defaults(&mut table, &environment, method)?;
        }
        table.entry(method).or_insert_with(|| Table::new().into());
    }
    Ok((name, resolve(table, overrides, what)?))
}

fn preset(name: &str) -> Option<(&'static str, &'static str)> {
    PRESETS.into_iter().find(|(known, _)| *known == name)
}

/// The sections of a preset or a file, and the default name of its run.
fn sections(what: &str) -> anyhow::Result<(String, Table)> {
    if let Some((name, text)) = preset(what) {
        return Ok((name.into(), text.parse().with_context(|| format!("preset {name}"))?));
    }
    if let Some(id) = what.strip_prefix(GYMNASIUM) {
        let mut table = Table::new();
        put(&mut table, &["environment", "name"], what.into())?;
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
        return Ok((format!("gym-{}", id.replace(|c| !is_plain(c), "-")), table));
    }
    let path = PathBuf::from(what);
    if path.extension().is_none_or(|extension| extension != "toml") {
        let known: Vec<&str> = preset_names().collect();
        bail!(
            "there is no preset `{what}`: choose {}, a file that ends in .toml, or gym: with a Gymnasium environment",
            known.join(", ")
        );
    }
    let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {what}"))?;
    let table = text
        .parse::<Table>()
        .map_err(|error| anyhow::anyhow!("{what}: {}", one_line(&error)))?;
    let name = path
        .file_stem()
        .map_or_else(|| "run".into(), |stem| stem.to_string_lossy().into_owned());
    Ok((name, table))
}

fn resolve(mut table: Table, overrides: &RunOverrides, origin: &str) -> anyhow::Result<Config> {
    let mut set = |section: &str, key: &str, value: Value| put(&mut table, &[section, key], value);
    if let Some(seed) = overrides.seed {
        let seed = i64::try_from(seed).context("--seed: must be below 2^63")?;
        set("run", "seed", seed.into())?;
    }
    if let Some(steps) = overrides.steps {
        set(
            "run",
            "steps",
            i64::try_from(steps).context("--steps: must be below 2^63")?.into(),
        )?;
    }
    if let Some(actors) = overrides.actors {
        set("actors", "count", i64::from(actors).into())?;
    }
    if let Some(envs) = overrides.envs {
        set("actors", "envs", i64::from(envs).into())?;
    }
    if let Some(episodes) = overrides.episodes {
        let episodes = i64::try_from(episodes).context("--episodes: must be below 2^63")?;
        set("run", "episodes", episodes.into())?;
    }
    if overrides.lockstep {
        set("run", "mode", "lockstep".into())?;
    }
    for assignment in &overrides.set {
        let (key, value) = assignment
            .split_once('=')
            .filter(|(key, _)| key.contains('.'))
            .with_context(|| format!("--set {assignment}: must look like SECTION.KEY=VALUE"))?;
        let path: Vec<&str> = key.split('.').collect();
        if path[0] == "spec" || FILLED_IN.contains(&key) {
            bail!("--set {assignment}: {key} cannot be set: the program sets it");
        }
        put(&mut table, &path, value_of(value)).with_context(|| format!("--set {assignment}"))?;
    }
    // For more actors than the default of `actors.max`, raise it.
    if let Some(count) = table
        .get("actors")
        .and_then(|actors| actors.get("count"))
        .and_then(Value::as_integer)
        && count > i64::from(ActorsConfig::default().max)
        && table.get("actors").is_some_and(|actors| actors.get("max").is_none())
    {
        put(&mut table, &["actors", "max"], count.into())?;
    }
    // Random and independent of the seed: the run's name in shared memory must be unique.
    put(
        &mut table,
        &["run", "id"],
        format!("{:08x}", rand::random::<u32>()).into(),
    )?;
    let format = i64::from(u32::from(IdentityFormat::NEWEST));
    put(&mut table, &["run", "identity_format"], format.into())?;
    describe_environment(&mut table)?;
    let mut config = Config::from_table(table, origin)?;
    // A short run must end with an evaluation too.
    config.evaluation.every = config.evaluation.every.min(config.run.steps);
    if let Algorithm::Dqn(dqn) = &mut config.algorithm
        && dqn.epsilon_steps == 0
    {
        dqn.epsilon_steps = (config.run.steps / 10).max(1);
    }
    Ok(config)
}

/// Fills in `[spec]` from the environment. Adds every parameter of a built-in environment, and for a Gymnasium
/// environment the settings of a suitable method if the configuration names none.
fn describe_environment(table: &mut Table) -> anyhow::Result<()> {
    let run = table.get("run");
    let mode = run.and_then(|run| run.get("mode")).and_then(Value::as_str);
    let mode = if mode == Some("lockstep") {
        Mode::Lockstep
    } else {
        Mode::Free
    };
    let seed = run.and_then(|run| run.get("seed")).and_then(Value::as_integer);
    let seed = seed.map_or(RunConfig::default().seed, i64::cast_unsigned);
    let Some(Value::Table(section)) = table.get_mut("environment") else {
        bail!("the section [environment] is missing: it must have a name");
    };
    let Some(Value::String(name)) = section.remove("name") else {
        bail!(
            "environment.name is missing: it must be one of {}, or start with {GYMNASIUM}",
            environment::names().collect::<Vec<_>>().join(", ")
        );
    };
    let server = take(section, "server")?.or_else(|| external_environment::default_command(&name));
    let (faults, start_seconds) = (take(section, "faults")?, take(section, "start_seconds")?);
    let configured = |name, server, parameters| {
        let mut environment = EnvironmentConfig::new(name, server, parameters);
        environment.faults = faults.unwrap_or(environment.faults);
        environment.start_seconds = start_seconds.unwrap_or(environment.start_seconds);
        environment
    };
    let (environment, spec) = if let Some(server) = server {
        let environment = configured(name, server, section.clone());
        let surroundings = Surroundings {
            location: ServerLocation::here(&environment.server)?,
            hash_seed: hash_seed(mode, seed),
        };
        let spec = ExternalEnvironment::begin_in(&environment, 1, 0, surroundings, Interrupt::default())?
            .spec()
            .clone();
        (environment, spec)
    } else {
        let parameters = environment::resolve(&name, section)?;
        let spec = environment::make(&name, &parameters)?.spec();
        (configured(name, Vec::new(), parameters), spec)
    };
    let named = method::named_in(table);
    if environment.name.starts_with(GYMNASIUM) {
        let method = named.unwrap_or_else(|| method::suitable(&spec));
        method::add_defaults(table, &environment.name, method)?;
    }
    method::fit(table, &spec);
    table.insert("environment".into(), Value::try_from(environment)?);
    table.insert("spec".into(), Value::try_from(spec)?);
    Ok(())
}

/// Takes a key of `[environment]` that is no parameter of the environment.
fn take<T: DeserializeOwned>(section: &mut Table, key: &str) -> anyhow::Result<Option<T>> {
    let value = section.remove(key).map(Value::try_into).transpose();
    value.map_err(|error| anyhow::anyhow!("environment.{key}: {}", one_line(&error)))
}

fn put(table: &mut Table, path: &[&str], value: Value) -> anyhow::Result<()> {
    match path {
        [] => Ok(()),
        [key] => {
            table.insert((*key).into(), value);
            Ok(())
        }
        [section, rest @ ..] => match table.entry(*section).or_insert_with(|| Table::new().into()) {
            Value::Table(inner) => put(inner, rest, value),
            _ => bail!("`{section}` is a value, not a section"),
        },
    }
}

/// The text as a TOML value, or as a string if it is not valid TOML: `reward=r2` needs no quotes.
fn value_of(text: &str) -> Value {
    format!("value = {text}")
        .parse::<Table>()
        .ok()
        .and_then(|mut table| table.remove("value"))
        .unwrap_or_else(|| text.into())
}

fn one_line(error: &toml::de::Error) -> String {
    error.message().replace('\n', " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plan(what: &str, set: &[&str]) -> anyhow::Result<Config> {
        let overrides = RunOverrides {
            set: set.iter().map(|assignment| (*assignment).into()).collect(),
            ..RunOverrides::default()
        };
        decide(what, &overrides).map(|(_, config)| config)
    }

    #[test]
    fn every_preset_is_a_configuration() {
        for (name, _) in PRESETS {
            let config = plan(name, &[]).unwrap();
            let limit = if name.starts_with("frozen-lake") { 100 } else { 200 };
            assert_eq!(config.spec.time_limit, limit, "{name}");
            assert!(
                !config.environment.parameters.is_empty(),
                "every parameter is set: {:?}",
                config.environment
            );
        }
    }

    /// If this text changes, earlier runs cannot be resumed unless the identity format gets a new number.
    #[test]
    fn the_identity_of_every_preset_is_unchanged_since_its_release() {
        let mut all = String::new();
        for (name, _) in PRESETS {
            let config = plan(name, &[]).unwrap();
            all += &format!("# {name}\n{}\n", config.identity());
            let other_rate = plan(name, &["evaluation.every=77", "run.steps=1234"]).unwrap();
            assert_eq!(other_rate.identity(), config.identity(), "{name}");
            assert_ne!(
                plan(name, &["run.seed=5"]).unwrap().identity(),
                config.identity(),
                "{name}"
            );
        }
        assert_eq!(all, include_str!("../../tests/data/identity-1.txt"));
    }

    #[test]
    fn a_new_run_has_the_identity_that_its_directory_has() {
        let parent = tempfile::tempdir().unwrap();
        let run = RunDir::create(&parent.path().join("run")).unwrap();
        let mut config = plan("pendulum", &[]).unwrap();
        // Parameters that other programs may take.
        let parameters = "day = 1979-05-27\nx = [nan, -inf, 1e300]\n[parameters]\nname = \"x\"";
        config.environment.parameters = parameters.parse().unwrap();
        let filled = fill(&run, &config).unwrap();
        let read = run.config().unwrap();
        assert_eq!(filled.identity(), read.identity());
        run.write_config(&read).unwrap();
        assert_eq!(
            filled.identity(),
            run.config().unwrap().identity(),
            "as resume and scale write it"
        );
    }

    #[test]
    fn overrides_change_the_configuration() {
        let overrides = RunOverrides {
            seed: Some(7),
            steps: Some(500),
            actors: Some(3),
            envs: Some(2),
            lockstep: true,
            set: [
                "environment.reward=r2",
                "environment.friction=0.03",
                "ddpg.hidden=[20, 10]",
            ]
            .map(Into::into)
            .into(),
            ..RunOverrides::default()
        };
        let (name, config) = decide("point-mass-r3", &overrides).unwrap();
        assert_eq!(name, "point-mass-r3");
        assert_eq!(
            (
                config.run.seed,
                config.run.steps,
                config.run.mode,
                config.actors.count,
                config.actors.envs
            ),
            (7, 500, Mode::Lockstep, 3, 2)
        );
        assert_eq!(config.environment.parameters["reward"].as_str(), Some("r2"));
        assert_eq!(config.environment.parameters["friction"].as_float(), Some(0.03));
        assert_eq!(*config.algorithm.ddpg().unwrap().hidden, [20, 10]);
    }

    #[test]
    fn errors_in_the_configuration_are_one_line() {
        for (what, set, part) in [
            ("pendulums", "", "no preset `pendulums`"),
            ("missing.toml", "", "missing.toml"),
            ("pendulum", "ddpg.gama=1", "gama"),
            ("pendulum", "dpg.gamma=1", "dpg"),
            ("pendulum", "gamma=1", "SECTION.KEY=VALUE"),
            ("pendulum", "spec.time_limit=50", "cannot be set"),
            ("pendulum", "ddpg.gamma=2", "ddpg.gamma = 2: must be from 0 to 1"),
            ("pendulum", "ddpg.gamma=high", "high"),
            ("pendulum", "environment.start_sped=1", "start_sped"),
            ("pendulum", "environment.name=pendule", "pendule"),
            ("pendulum", "actors.count=0", "actors.count = 0"),
        ] {
            let set: Vec<&str> = (!set.is_empty()).then_some(set).into_iter().collect();
            let message = format!("{:#}", plan(what, &set).unwrap_err());
            assert!(
                message.contains(part) && !message.contains('\n'),
                "{what} {set:?}: {message}"
            );
        }
    }
}
