//! The configuration of a new run: presets, files and overrides become one resolved configuration. No later code reads
//! command-line options.

mod revision;
mod source;
mod suggestion;

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::de::DeserializeOwned;
use shoal_common::algorithms::TransitionUse;
use shoal_common::config::explanation::{self, Key};
use shoal_common::config::{ActorsConfig, AlgorithmConfig, Config, EnvironmentConfig, IdentityFormat, Mode, RunConfig};
use shoal_common::run_dir::{RunDir, RunLock};
use shoal_common::section;
use shoal_env_server::environment::{self, EnvironmentError};
use toml::{Table, Value};

use self::revision::as_written;
pub use self::revision::{RequestedChanges, Revision, edited, store_actors};
pub use self::source::{SettingSource, SettingSources, UsageError};
use self::suggestion::{nearest, with_suggestion};

use crate::algorithm;
use crate::external_environment::{self, ExternalEnvironment, GYMNASIUM};
use crate::numbers::count;
use crate::origin::{Origin, Predecessor, shapes};
use crate::preflight;
use crate::server_location::{ServerLocation, ServerSurroundings, hash_seed};
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
    // Those for another algorithm than the thesis's have the name of their task and that of the algorithm.
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

/// The presets' names.
pub fn preset_names() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().map(|(name, _)| *name)
}

/// The resolved configuration of a preset or a file, without overrides.
pub fn resolved(what: &str) -> anyhow::Result<Config> {
    decide(what, &RunOverrides::default()).map(|(_, config)| config)
}

/// The resolved configuration of a preset or a file with these overrides, and where each value comes from.
pub fn resolved_with_sources(what: &str, overrides: &RunOverrides) -> anyhow::Result<(Config, SettingSources)> {
    let (_, table, sources) = for_algorithm(what, overrides)?;
    resolve(table, sources, overrides, what)
}

/// What is worth a warning before a run of this configuration starts or goes on.
pub fn warning(config: &Config) -> Option<String> {
    let (steps, warmup) = (config.run.steps, config.replay.warmup);
    (steps <= warmup && config.replay.updates_per_step > 0.0).then(|| {
        format!(
            "nothing will be learned: the first update comes after the warm-up of {warmup} steps, and the run has {steps}; \
             give it more with --steps, or lower replay.warmup"
        )
    })
}

/// Changes to a preset or a file for one run.
#[derive(Clone, Debug, Default)]
pub struct RunOverrides {
    /// Run directory to create; by default `runs/<name>-<n>`.
    pub run: Option<PathBuf>,
    /// The algorithm, by its name.
    pub algorithm: Option<String>,
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
    /// A run whose networks this one begins with.
    pub from: Option<PathBuf>,
    /// Whether it also begins with that run's replay.
    pub with_replay: bool,
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
    /// What it begins with, if that is not its own.
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
        let (name, mut config) = decide(what, overrides)?;
        let from = overrides.from.as_deref();
        let from = from
            .map(|from| Predecessor::open(from, overrides.with_replay))
            .transpose()?;
        if let Some(predecessor) = &from {
            predecessor.prepare(&mut config)?;
        }
        let place = overrides.run.clone().unwrap_or_else(|| Path::new("runs").join(&name));
        preflight::check(&config, &RunDir::planned(&place))?;
        let run = match &overrides.run {
            Some(path) => RunDir::create(path)?,
            None => RunDir::create_next(Path::new("runs"), &name)?,
        };
        let lock = run.lock()?;
        let begin = || {
            let config = fill(&run, &config)?;
            let origin = from.as_ref().map(|predecessor| predecessor.begin(&run, &config));
            Ok((config, origin.transpose()?))
        };
        let (config, origin) = begin().inspect_err(|_: &anyhow::Error| {
            // The directory would block the next attempt.
            let _ = std::fs::remove_dir_all(run.path());
        })?;
        let of_rows = from.and_then(|predecessor| predecessor.warning(&config));
        Ok(Self {
            warnings: warning(&config).into_iter().chain(of_rows).collect(),
            config,
            run,
            lock,
            origin,
        })
    }
}

/// Writes the first files of a new run directory and returns the configuration as the roles read it: a date among the
/// environment's parameters is a string there, and all processes must compute the same identity.
fn fill(run: &RunDir, config: &Config) -> anyhow::Result<Config> {
    if let Some(location) = ServerLocation::here(&config.environment.server)? {
        location.write(run)?;
    }
    run.write_config(&as_written(config))?;
    let mut read = run.config()?;
    (read.replay.ratio_since, read.replay.updates_before) = (config.replay.ratio_since, config.replay.updates_before);
    run.write_used_config(&read)?;
    Ok(read)
}

/// The configuration of a preset or a file with these overrides, and the default name of its run. Creates nothing.
pub fn decide(what: &str, overrides: &RunOverrides) -> anyhow::Result<(String, Config)> {
    let (name, table, sources) = for_algorithm(what, overrides)?;
    let (config, _) = resolve(table, sources, overrides, what)?;
    Ok((name, config))
}

fn preset(name: &str) -> Option<(&'static str, &'static str)> {
    PRESETS.into_iter().find(|(known, _)| *known == name)
}

/// As [`sections`], for the algorithm that is asked for.
fn for_algorithm(what: &str, overrides: &RunOverrides) -> anyhow::Result<(String, Table, SettingSources)> {
    let (mut name, mut table, mut sources) = sections(what)?;
    let asked = algorithm::asked_for(overrides.algorithm.as_deref(), &overrides.set)?;
    let of_networks = predecessor(overrides)?.map(|(_, config)| config.algorithm.name());
    let Some(algorithm) = asked.or(of_networks) else {
        return Ok((name, table, sources));
    };
    let named = algorithm::named_in(&table);
    // A preset for another algorithm than its task's first one ends with that algorithm's name.
    let task = named
        .and_then(|named| what.strip_suffix(named)?.strip_suffix('-'))
        .unwrap_or(what);
    if let Some((own, _)) = preset(&format!("{task}-{algorithm}")) {
        return sections(own);
    }
    let default = AlgorithmConfig::default().name();
    if task != what && algorithm == default && preset(task).is_some() {
        return sections(task);
    }
    let defaults = SettingSource::Algorithm(algorithm);
    if preset(what).is_some() {
        if named.unwrap_or(default) != algorithm {
            let before = algorithm::replace(&mut table, algorithm)?;
            sources = SettingSources::of_preset(&name, &before);
            name = format!("{name}-{algorithm}");
        }
    } else if let Some(other) = named.filter(|named| *named != algorithm) {
        bail!("{what} is for {other}, but {algorithm} is asked for: remove what belongs to {other} from the file");
    } else if named.is_none() && algorithm != default {
        let environment = table.get("environment").and_then(|section| section.get("name"));
        let environment = environment.and_then(Value::as_str).unwrap_or_default().to_owned();
        algorithm::add_defaults(&mut table, &environment, algorithm)?;
    }
    table.entry(algorithm).or_insert_with(|| Table::new().into());
    sources.add(&table, &defaults);
    Ok((name, table, sources))
}

/// The default name of a run of a preset or a file, its sections, and where their values come from.
fn sections(what: &str) -> anyhow::Result<(String, Table, SettingSources)> {
    if let Some((name, text)) = preset(what) {
        let table = text.parse().with_context(|| format!("preset {name}"))?;
        let sources = SettingSources::of_preset(name, &table);
        return Ok((name.into(), table, sources));
    }
    if let Some(id) = what.strip_prefix(GYMNASIUM) {
        let mut table = Table::new();
        put(&mut table, &["environment", "name"], what.into())?;
        let is_plain = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
        let name = format!("gym-{}", id.replace(|c| !is_plain(c), "-"));
        return Ok((name, table, SettingSources::default()));
    }
    let path = PathBuf::from(what);
    if path.extension().is_none_or(|extension| extension != "toml") {
        return Err(UsageError(no_preset(what)).into());
    }
    let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {what}"))?;
    let table = text
        .parse::<Table>()
        .map_err(|error| anyhow::anyhow!("{}", section::malformed(what, &text, &error)))?;
    let name = path
        .file_stem()
        .map_or_else(|| "run".into(), |stem| stem.to_string_lossy().into_owned());
    let sources = SettingSources::of_file(what, &text);
    Ok((name, table, sources))
}

/// The error for a name that is neither a preset nor a file.
fn no_preset(what: &str) -> String {
    let known: Vec<&str> = preset_names().collect();
    let all = format!(
        "choose {}, a file that ends in .toml, or gym: with a Gymnasium environment",
        known.join(", ")
    );
    if is_gymnasium(what) {
        return format!("there is no preset `{what}`; did you mean {GYMNASIUM}{what}? Otherwise {all}");
    }
    match nearest(what, known) {
        Some(near) => format!("there is no preset `{what}`; did you mean {near}? Otherwise {all}"),
        None => format!("there is no preset `{what}`: {all}"),
    }
}

/// Whether this looks like the name of a Gymnasium environment, which ends in a version: `Pendulum-v1`.
fn is_gymnasium(name: &str) -> bool {
    let version = name.rsplit_once("-v").map(|(_, version)| version);
    version.is_some_and(|version| !version.is_empty() && version.bytes().all(|byte| byte.is_ascii_digit()))
}

fn resolve(
    mut table: Table,
    mut sources: SettingSources,
    overrides: &RunOverrides,
    origin: &str,
) -> anyhow::Result<(Config, SettingSources)> {
    set_options(&mut table, &mut sources, overrides)?;
    for assignment in &overrides.set {
        set_key(&mut table, &mut sources, assignment)?;
    }
    let mistaken = |error: UsageError, sources: &SettingSources, table: &Table| sources.explain(error.0, origin, table);
    read_counts(&mut table).map_err(|error| mistaken(error, &sources, &table))?;
    // For more actors than the default of `actors.max`, raise it, but not beyond its bounds.
    if let Some(count) = integer(&table, "actors", "count")
        && count > i64::from(ActorsConfig::default().max)
        && table.get("actors").is_some_and(|actors| actors.get("max").is_none())
    {
        put(
            &mut table,
            &["actors", "max"],
            count.min(ActorsConfig::GREATEST_MAX.into()).into(),
        )?;
        sources.set("actors.max".into(), SettingSource::Follows("actors.count".into()));
    }
    // A file may be the configuration of another run.
    for key in explanation::set_by_program() {
        if let Some((section, key)) = key.split_once('.')
            && let Some(Value::Table(values)) = table.get_mut(section)
        {
            values.remove(key);
        }
    }
    // Random and independent of the seed: the run's name in shared memory must be unique.
    put(
        &mut table,
        &["run", "id"],
        format!("{:08x}", rand::random::<u32>()).into(),
    )?;
    let format = i64::from(u32::from(IdentityFormat::NEWEST));
    put(&mut table, &["run", "identity_format"], format.into())?;
    let chosen = table.clone();
    describe_environment(&mut table).map_err(|error| about_environment(error, &sources))?;
    // What is added are an algorithm's settings for a Gymnasium environment, and the environment's own defaults.
    sources.add_new(&chosen, &table, &SettingSource::Gymnasium);
    follow_algorithm(&mut table, &mut sources)?;
    follow_networks(&mut table, &mut sources, overrides)?;
    let mut config = Config::from_table(table.clone(), "").map_err(|error| {
        let message = error.to_string();
        let message = message.strip_prefix(": ").unwrap_or(&message);
        sources.explain(message.into(), origin, &table)
    })?;
    // A short run must end with an evaluation too.
    if config.run.steps < config.evaluation.every {
        config.evaluation.every = config.run.steps;
        sources.set("evaluation.every".into(), SettingSource::Follows("run.steps".into()));
    }
    set_what_follows(&mut config, &mut sources);
    Ok((config, sources))
}

/// Sets what follows from the run's length if it is left open.
fn set_what_follows(config: &mut Config, sources: &mut SettingSources) {
    if let AlgorithmConfig::Dqn(dqn) = &mut config.algorithm
        && dqn.epsilon_steps == 0
    {
        dqn.epsilon_steps = (config.run.steps / 10).max(1);
        sources.set("dqn.epsilon_steps".into(), SettingSource::Follows("run.steps".into()));
    }
}

/// Sets the keys that have options of their own.
fn set_options(table: &mut Table, sources: &mut SettingSources, overrides: &RunOverrides) -> anyhow::Result<()> {
    let whole = |option: &str, number: Option<u64>| -> anyhow::Result<Option<Value>> {
        let number = number.map(i64::try_from).transpose();
        Ok(number
            .with_context(|| format!("{option}: must be below 2^63"))?
            .map(Value::from))
    };
    let small = |number: Option<u32>| number.map(|number| Value::from(i64::from(number)));
    for (option, section, key, value) in [
        ("--seed", "run", "seed", whole("--seed", overrides.seed)?),
        ("--steps", "run", "steps", whole("--steps", overrides.steps)?),
        ("--actors", "actors", "count", small(overrides.actors)),
        ("--envs", "actors", "envs", small(overrides.envs)),
        (
            "--episodes",
            "run",
            "episodes",
            whole("--episodes", overrides.episodes)?,
        ),
        (
            "--lockstep",
            "run",
            "mode",
            overrides.lockstep.then(|| "lockstep".into()),
        ),
    ] {
        if let Some(value) = value {
            put(table, &[section, key], value)?;
            sources.set(format!("{section}.{key}"), SettingSource::Option(option));
        }
    }
    Ok(())
}

/// Sets a key as `--set` says.
fn set_key(table: &mut Table, sources: &mut SettingSources, assignment: &str) -> anyhow::Result<()> {
    let wrong = |why: String| UsageError(format!("--set {assignment}: {why}"));
    let (key, value) = assignment
        .split_once('=')
        .filter(|(key, _)| key.contains('.'))
        .ok_or_else(|| wrong("must look like SECTION.KEY=VALUE".into()))?;
    let path: Vec<&str> = key.split('.').collect();
    if path[0] == "spec" || explanation::set_by_program().iter().any(|own| own == key) {
        return Err(wrong(format!("{key} cannot be set: the program sets it")).into());
    }
    put(table, &path, value_of(value)).map_err(|error| wrong(error.to_string()))?;
    sources.set(
        path.iter().take(2).copied().collect::<Vec<_>>().join("."),
        SettingSource::Set,
    );
    Ok(())
}

fn integer(table: &Table, section: &str, key: &str) -> Option<i64> {
    table.get(section)?.get(key)?.as_integer()
}

/// Makes whole numbers of `1e5` and `30k` where a key takes whole numbers.
fn read_counts(table: &mut Table) -> Result<(), UsageError> {
    let mut keys: Vec<(&str, Key)> = Vec::new();
    for section in explanation::sections() {
        keys.extend(section.keys.into_iter().map(|key| (section.name, key)));
    }
    let name = table.get("environment").and_then(|section| section.get("name"));
    if let Some(own) = name
        .and_then(Value::as_str)
        .and_then(|name| environment::explain(name).ok())
    {
        keys.extend(own.into_iter().map(|key| ("environment", key)));
    }
    for (section, key) in keys.into_iter().filter(|(_, key)| key.whole) {
        let Some(value) = table.get_mut(section).and_then(|values| values.get_mut(&key.name)) else {
            continue;
        };
        let text = match value {
            Value::Float(number) => number.to_string(),
            Value::String(text) => text.clone(),
            _ => continue,
        };
        let read = count(&text).ok().and_then(|number| i64::try_from(number).ok());
        let refused = || {
            format!(
                "{section}.{} = {value}: must be a whole number, such as 1000, 1e5 or 30k",
                key.name
            )
        };
        *value = read.ok_or_else(|| UsageError(refused()))?.into();
    }
    Ok(())
}

/// The error about an environment's own parameters, with the place where the user has set the one at fault.
fn about_environment(error: anyhow::Error, sources: &SettingSources) -> anyhow::Error {
    let Some(of_environment) = error.downcast_ref::<EnvironmentError>() else {
        return error;
    };
    let (key, text) = match of_environment {
        EnvironmentError::UnknownName { name, .. } => {
            let near = nearest(name, environment::names()).map(str::to_owned);
            let near = Some(format!("{GYMNASIUM}{name}"))
                .filter(|_| is_gymnasium(name))
                .or(near);
            let hint = near.map_or_else(String::new, |near| format!("; did you mean {near}?"));
            ("name", format!("{of_environment}{hint}"))
        }
        EnvironmentError::Parameters { reason, .. } => {
            let key = reason.split('`').nth(1).unwrap_or_default();
            (key, with_suggestion(of_environment.to_string()))
        }
    };
    sources.error_naming_source(&format!("environment.{key}"), &text)
}

/// Directory and configuration of the run whose networks the new one begins with.
fn predecessor(overrides: &RunOverrides) -> anyhow::Result<Option<(PathBuf, Config)>> {
    let Some(from) = &overrides.from else { return Ok(None) };
    let run = RunDir::open(from)?;
    Ok(Some((run.path().to_owned(), run.config()?)))
}

/// Sets the shapes of the networks that a run begins with, unless the user has set others.
fn follow_networks(table: &mut Table, sources: &mut SettingSources, overrides: &RunOverrides) -> anyhow::Result<()> {
    let Some((path, config)) = predecessor(overrides)? else {
        return Ok(());
    };
    put(table, &["run", "from"], path.display().to_string().into())?;
    if !table.contains_key(config.algorithm.name()) {
        // Networks of another algorithm, which are refused later.
        return Ok(());
    }
    for (section, key, value) in shapes(&config)? {
        let name = format!("{section}.{key}");
        if !sources.of(&name).is_from_user() {
            put(table, &[section, &key], value)?;
            sources.set(name, SettingSource::Follows("--from".into()));
        }
    }
    Ok(())
}

/// Sets what the algorithm fixes, unless the user has set it.
fn follow_algorithm(table: &mut Table, sources: &mut SettingSources) -> anyhow::Result<()> {
    let limit = integer(table, "spec", "time_limit");
    let algorithms = AlgorithmConfig::all();
    let Some(algorithm) = algorithms.iter().find(|one| table.contains_key(one.name())) else {
        return Ok(());
    };
    let spec = algorithm.spec();
    let once = spec.transition_use != TransitionUse::Minibatches;
    let episodes = spec.transition_use == TransitionUse::Episodes;
    for (section, key, value) in [
        ("run", "mode", (!spec.off_policy).then(|| Value::from("lockstep"))),
        ("replay", "warmup", once.then(|| 0.into())),
        ("replay", "updates_per_step", once.then(|| 1.0.into())),
        ("actors", "chunk_steps", limit.filter(|_| episodes).map(Value::from)),
    ] {
        let name = format!("{section}.{key}");
        let now = table.get(section).and_then(|values| values.get(key));
        let Some(value) = value.filter(|value| now != Some(value) && !sources.of(&name).is_from_user()) else {
            continue;
        };
        put(table, &[section, key], value)?;
        sources.set(name, SettingSource::Follows(algorithm.name().into()));
    }
    Ok(())
}

/// Fills in `[spec]` from the environment. Adds every parameter of a built-in environment, and for a Gymnasium
/// environment the settings of a suitable algorithm if the configuration names none.
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
        let surroundings = ServerSurroundings {
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
    let named = algorithm::named_in(table);
    if environment.name.starts_with(GYMNASIUM) {
        let algorithm = named.unwrap_or_else(|| algorithm::suitable(&spec));
        algorithm::add_defaults(table, &environment.name, algorithm)?;
    }
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
    fn a_method_has_its_preset_for_the_task_or_its_own_defaults() {
        let with = |what: &str, algorithm: &str, set: &[&str]| {
            let overrides = RunOverrides {
                algorithm: (!algorithm.is_empty()).then(|| algorithm.into()),
                set: set.iter().map(|assignment| (*assignment).into()).collect(),
                ..RunOverrides::default()
            };
            decide(what, &overrides).unwrap()
        };
        let (name, own) = with("pendulum", "sac", &[]);
        assert_eq!((name.as_str(), own.run.steps), ("pendulum-sac", 20_000));
        assert_eq!(with("pendulum", "", &["sac.tau=0.01"]).1.replay, own.replay);
        assert_eq!(with("pendulum-sac", "td3", &[]).0, "pendulum-td3");
        assert_eq!(with("pendulum-sac", "ddpg", &[]).0, "pendulum");
        assert_eq!(
            with("pendulum", "ddpg", &[]).1.algorithm,
            resolved("pendulum").unwrap().algorithm
        );
        // There is no preset for the pole with DQN: the task's length and evaluation, and the algorithm's defaults.
        let (name, dqn) = with("cart-pole", "dqn", &["run.steps=40_000"]);
        assert_eq!(name, "cart-pole-dqn");
        assert_eq!((dqn.run.mode, dqn.replay.updates_per_step), (Mode::Free, 0.25));
        assert_eq!((dqn.run.episodes, dqn.actors.chunk_steps), (Some(5_000), 8));
        let AlgorithmConfig::Dqn(settings) = dqn.algorithm else {
            panic!("{:?}", dqn.algorithm)
        };
        assert_eq!(settings.epsilon_steps, 4_000, "a tenth of the run");
        let (_, lake) = with("frozen-lake", "sarsa", &[]);
        assert_eq!((lake.algorithm.name(), lake.run.mode), ("sarsa", Mode::Lockstep));
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
