//! Changes to a preset or a file that the command line asks for.

use std::path::{Path, PathBuf};

use anyhow::Context;
use clap::builder::PossibleValuesParser;
use clap::{Args, Parser};
use shoal_common::config::explanation::{self, Key};
use shoal_common::config::{AlgorithmConfig, Config, OutOfRange};
use shoal_common::run_dir::RunDir;
use shoal_env_server::environment;
use toml::{Table, Value};

use super::source::{SettingSource, SettingSources};
use super::table::put;
use crate::external_environment::GYMNASIUM;
use crate::numbers::{parse_count, parse_small_count};
use crate::plan::algorithm;
use crate::usage::UsageError;

/// Changes to a preset or a file for one run: the options of `train` that say what the run is.
#[derive(Args, Clone, Debug, Default)]
pub struct RunOverrides {
    /// Run directory to create [default: runs/<preset>-<n>].
    #[arg(long, value_name = "DIR")]
    pub run: Option<PathBuf>,
    /// The algorithm [default: the preset's; for gym: the one that suits the environment].
    #[arg(long = "method", visible_alias = "algorithm", value_name = "ALGORITHM", value_parser = PossibleValuesParser::new(algorithm::names()))]
    pub algorithm: Option<String>,
    /// Seed of every random stream.
    #[arg(long, value_parser = parse_count)]
    pub seed: Option<u64>,
    /// Actor processes.
    #[arg(long, value_name = "N", value_parser = parse_small_count)]
    pub actors: Option<u32>,
    /// Environments of each actor.
    #[arg(long, value_name = "E", value_parser = parse_small_count)]
    pub envs: Option<u32>,
    /// Environment steps of all actors together.
    #[arg(long, value_name = "N", value_parser = parse_count)]
    pub steps: Option<u64>,
    /// Episodes of all actors together; the run ends at this limit or at its steps, whichever comes first.
    #[arg(long, value_name = "M", value_parser = parse_count)]
    pub episodes: Option<u64>,
    /// Lockstep: actors and learner take turns, and the same seed and number of actors give the same bits.
    #[arg(long)]
    pub lockstep: bool,
    /// Set a key of the configuration, as in --set ddpg.tau=0.005. May be repeated.
    #[arg(long, value_name = "SECTION.KEY=VALUE")]
    pub set: Vec<String>,
    /// Begin with the networks of this run, and take over its algorithm and the shapes of its networks.
    #[arg(long, value_name = "RUN")]
    pub from: Option<PathBuf>,
    /// Begin with the replay of that run too. The new run's steps are counted from its rows on.
    #[arg(long, requires = "from")]
    pub with_replay: bool,
    /// Begin with the rows of this dataset of Minari in the replay: its name, like pendulum/expert-v0, or a directory.
    /// The run's steps are counted from these rows on.
    #[arg(long, value_name = "DATASET", conflicts_with = "from")]
    pub demonstrations: Option<String>,
}

impl RunOverrides {
    /// The arguments of `train` for these overrides, except directory and seed.
    pub fn arguments(&self) -> Vec<String> {
        let Self {
            run: _,
            algorithm,
            seed: _,
            actors,
            envs,
            steps,
            episodes,
            lockstep,
            set,
            from,
            with_replay,
            demonstrations,
        } = self;
        let mut arguments = Vec::new();
        let mut option = |name: &str, value: Option<String>| {
            arguments.extend(value.into_iter().flat_map(|value| [name.to_owned(), value]));
        };
        option("--method", algorithm.clone());
        option("--actors", actors.map(|number| number.to_string()));
        option("--envs", envs.map(|number| number.to_string()));
        option("--steps", steps.map(|number| number.to_string()));
        option("--episodes", episodes.map(|number| number.to_string()));
        option("--from", from.as_ref().map(|path| path.display().to_string()));
        option("--demonstrations", demonstrations.clone());
        set.iter()
            .for_each(|assignment| option("--set", Some(assignment.clone())));
        arguments.extend(lockstep.then(|| "--lockstep".into()));
        arguments.extend(with_replay.then(|| "--with-replay".into()));
        arguments
    }

    /// The overrides of arguments that [`arguments`](Self::arguments) has returned.
    ///
    /// # Errors
    /// When there is another argument among them.
    pub fn from_arguments(arguments: &[String]) -> anyhow::Result<Self> {
        #[derive(Parser)]
        struct Arguments {
            #[command(flatten)]
            overrides: RunOverrides,
        }
        let words = std::iter::once("train").chain(arguments.iter().map(String::as_str));
        let parsed = Arguments::try_parse_from(words).context("the arguments of the suite are damaged")?;
        Ok(parsed.overrides)
    }

    /// The dataset for a process in another directory.
    ///
    /// # Errors
    /// When the current directory is unknown.
    pub fn absolute_dataset(&self) -> anyhow::Result<Option<String>> {
        let absolute = |dataset: &String| match Path::new(dataset).is_dir() {
            true => Ok(std::path::absolute(dataset)?.display().to_string()),
            false => Ok(dataset.clone()),
        };
        self.demonstrations.as_ref().map(absolute).transpose()
    }

    /// Directory and configuration of the run whose networks the new one begins with.
    pub(super) fn source_run(&self) -> anyhow::Result<Option<(PathBuf, Config)>> {
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
    let RunOverrides {
        seed,
        actors,
        envs,
        steps,
        episodes,
        lockstep,
        // The others set no key of their own, or come before.
        run: _,
        algorithm: _,
        set: _,
        from: _,
        with_replay: _,
        demonstrations: _,
    } = *overrides;
    for (option, section, key, value) in [
        ("--seed", "run", "seed", whole("--seed", seed)?),
        ("--steps", "run", "steps", whole("--steps", steps)?),
        ("--actors", "actors", "count", small(actors)),
        ("--envs", "actors", "envs", small(envs)),
        ("--episodes", "run", "episodes", whole("--episodes", episodes)?),
        ("--lockstep", "run", "mode", lockstep.then(|| "lockstep".into())),
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
    let (key, value) = assignment.split_once('=').unwrap_or((assignment, ""));
    let path: Vec<&str> = key.split('.').collect();
    if !assignment.contains('=') || path.len() < 2 || path.contains(&"") {
        let hint = did_you_mean(key, table);
        return Err(wrong(format!("must look like SECTION.KEY=VALUE{hint}")).into());
    }
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

/// A hint for a key without its section: the sections that have it, if there are any.
fn did_you_mean(key: &str, table: &Table) -> String {
    let sections = explanation::sections();
    let having = sections.iter().filter(|of| of.keys.iter().any(|own| own.name == key));
    let all: Vec<&str> = having.map(|section| section.name).collect();
    // The algorithm of a Gymnasium environment is not known yet.
    let name = table.get("environment").and_then(|section| section.get("name"));
    let is_known = !name
        .and_then(Value::as_str)
        .is_some_and(|name| name.starts_with(GYMNASIUM));
    let default = is_known.then(|| AlgorithmConfig::default().name());
    let algorithm = AlgorithmConfig::named_in(table).map(|named| named.name).or(default);
    let is_likely = |name: &&str| table.contains_key(*name) || algorithm == Some(*name);
    let mut likely: Vec<&str> = all.iter().copied().filter(is_likely).collect();
    if likely.is_empty() {
        likely = all;
    }
    let keys: Vec<String> = likely.iter().map(|section| format!("{section}.{key}")).collect();
    match keys.is_empty() {
        true => String::new(),
        false => format!("; did you mean {}?", keys.join(" or ")),
    }
}

/// Replaces numbers such as `1e5` and `30k` by whole numbers, for keys that take whole numbers.
pub(super) fn read_counts(table: &mut Table) -> Result<(), OutOfRange> {
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
        let read = parse_count(&text).ok().and_then(|number| i64::try_from(number).ok());
        let refused = || OutOfRange {
            key: format!("{section}.{}", key.name),
            value: value.to_string(),
            expected: "a whole number, such as 1000, 1e5 or 30k".into(),
        };
        *value = read.ok_or_else(refused)?.into();
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
    use super::super::resolve::resolve;
    use super::*;
    use clap::Parser;
    use shoal_common::config::Mode;

    #[derive(clap::Parser)]
    struct CommandLine {
        #[command(flatten)]
        overrides: RunOverrides,
    }

    #[test]
    fn the_arguments_of_overrides_are_read_as_the_same_overrides() {
        let line = "train --method sac --actors 3 --envs 2 --steps 500 --episodes 9 --from old --set sac.tau=0.01 \
                    --set run.mode=free --lockstep --with-replay";
        let CommandLine { overrides } = CommandLine::parse_from(line.split(' ').filter(|word| !word.is_empty()));
        let arguments = overrides.arguments();
        let again = CommandLine::parse_from(["train".to_owned()].into_iter().chain(arguments.clone())).overrides;
        assert_eq!(format!("{overrides:?}"), format!("{again:?}"));
        let mut given: Vec<&str> = line.split(' ').skip(1).filter(|word| !word.is_empty()).collect();
        let mut written: Vec<&str> = arguments.iter().map(String::as_str).collect();
        given.sort_unstable();
        written.sort_unstable();
        assert_eq!(written, given);

        let line = ["train", "--demonstrations", "pendulum/expert-v0"];
        let CommandLine { overrides } = CommandLine::parse_from(line);
        assert_eq!(overrides.arguments(), line[1..]);
        let both = [&line[..], &["--from", "old"]].concat();
        assert!(
            CommandLine::try_parse_from(both).is_err(),
            "the rows are of one or of the other"
        );
    }

    #[test]
    fn a_key_without_its_section_is_found() {
        let refused = |what: &str, assignment: &str| {
            let set = vec![assignment.to_owned()];
            let overrides = RunOverrides {
                set,
                ..RunOverrides::default()
            };
            resolve(what, &overrides).unwrap_err().to_string()
        };
        let form = "must look like SECTION.KEY=VALUE";
        for (what, assignment, expected) in [
            (
                "pendulum-sac",
                "tau=1",
                format!("--set tau=1: {form}; did you mean sac.tau?"),
            ),
            (
                "pendulum",
                "tau=",
                format!("--set tau=: {form}; did you mean ddpg.tau?"),
            ),
            (
                "pendulum",
                "warmup",
                format!("--set warmup: {form}; did you mean exploration.warmup or replay.warmup?"),
            ),
            ("pendulum", "nothing=1", format!("--set nothing=1: {form}")),
            ("pendulum", ".=1", format!("--set .=1: {form}")),
            ("pendulum", "ddpg.=1", format!("--set ddpg.=1: {form}")),
        ] {
            assert_eq!(refused(what, assignment), expected);
        }
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
        let (name, config) = resolve("point-mass-r3", &overrides).unwrap();
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
