//! Changes to a preset or a file that the command line asks for.

use std::path::PathBuf;

use anyhow::Context;
use shoal_common::config::Config;
use shoal_common::config::explanation::{self, Key};
use shoal_common::run_dir::RunDir;
use shoal_env_server::environment;
use toml::{Table, Value};

use super::source::{SettingSource, SettingSources};
use super::table::put;
use crate::numbers::count;
use crate::usage::UsageError;

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

impl RunOverrides {
    /// Directory and configuration of the run whose networks the new one begins with.
    pub(super) fn predecessor(&self) -> anyhow::Result<Option<(PathBuf, Config)>> {
        let Some(from) = &self.from else { return Ok(None) };
        let run = RunDir::open(from)?;
        Ok(Some((run.path().to_owned(), run.config()?)))
    }
}

/// Sets the keys that have options of their own.
pub(super) fn set_options(
    table: &mut Table,
    sources: &mut SettingSources,
    overrides: &RunOverrides,
) -> anyhow::Result<()> {
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
pub(super) fn set_key(table: &mut Table, sources: &mut SettingSources, assignment: &str) -> anyhow::Result<()> {
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

/// Makes whole numbers of `1e5` and `30k` where a key takes whole numbers.
pub(super) fn read_counts(table: &mut Table) -> Result<(), UsageError> {
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

/// The text as a TOML value, or as a string if it is not valid TOML: `reward=r2` needs no quotes.
fn value_of(text: &str) -> Value {
    format!("value = {text}")
        .parse::<Table>()
        .ok()
        .and_then(|mut table| table.remove("value"))
        .unwrap_or_else(|| text.into())
}

#[cfg(test)]
mod tests {
    use super::super::resolve::decide;
    use super::*;
    use shoal_common::config::Mode;

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
}
