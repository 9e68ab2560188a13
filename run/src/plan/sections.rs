//! The sections that a configuration begins with, for the algorithm that is asked for. They come from a preset, a file
//! or a Gymnasium environment.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use shoal_common::config::AlgorithmConfig;
use shoal_common::section;
use toml::{Table, Value};

use super::overrides::RunOverrides;
use super::presets::{preset, preset_names, with_algorithm};
use super::source::{SettingSource, SettingSources};
use super::suggestion::nearest;
use super::table::put;
use crate::external_environment::GYMNASIUM;
use crate::plan::algorithm;
use crate::usage::UsageError;

/// The default name of a run of a preset or a file, and its sections for the requested algorithm.
pub(super) fn sections_for_algorithm(
    what: &str,
    overrides: &RunOverrides,
) -> anyhow::Result<(String, Table, SettingSources)> {
    let (mut name, mut table, mut sources) = sections(what)?;
    let asked = algorithm::asked_for(overrides.algorithm.as_deref(), &overrides.set)?;
    let of_networks = overrides.source_run()?.map(|(_, config)| config.algorithm.name());
    let Some(algorithm) = asked.or(of_networks) else {
        return Ok((name, table, sources));
    };
    if let Some(own) = with_algorithm(what, algorithm) {
        (name, table, sources) = sections(own)?;
    }
    let named = AlgorithmConfig::named_in(&table).map(|named| named.name);
    let default = AlgorithmConfig::default().name();
    let defaults = SettingSource::Algorithm(algorithm);
    if preset(what).is_some() {
        if named.unwrap_or(default) != algorithm {
            let before = algorithm::replace(&mut table, algorithm)?;
            sources = SettingSources::of_preset(&name, &before);
            name = format!("{name}-{algorithm}");
        }
    } else if let Some(other) = named.filter(|named| *named != algorithm) {
        bail!("{what} is for {other}, but {algorithm} is requested: remove what belongs to {other} from the file");
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
    if !is_configuration_file(&path) {
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

/// Whether this is the name of a file with a configuration, as opposed to a preset.
pub fn is_configuration_file(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension == "toml")
}

/// The error for a name that is neither a preset nor a file with settings.
fn no_preset(what: &str) -> String {
    let path = Path::new(what);
    let usual = Path::new("runs").join(what);
    if path.join("config.toml").is_file() {
        return format!(
            "{what} is a run: to continue it, `shoal resume {what}`; to begin another one with its settings, `shoal \
             train {}`",
            path.join("config.toml").display()
        );
    }
    if path.join("suite.json").is_file() {
        return format!("{what} is a suite of runs: to continue it, `shoal resume {what}`");
    }
    let known: Vec<&str> = preset_names().collect();
    let all = format!(
        "choose {}, a file that ends in .toml, or gym: with a Gymnasium environment",
        known.join(", ")
    );
    if path.is_dir() {
        return format!("{what} is a directory without a run: {all}");
    }
    if path.is_file() {
        return format!("{what} is a file whose name does not end in .toml: {all}");
    }
    if usual.join("config.toml").is_file() {
        let usual = usual.display();
        return format!("there is no preset `{what}`, but a run: to continue it, `shoal resume {usual}`");
    }
    if what.contains('/') {
        return format!("there is no preset, directory or file `{what}`: {all}");
    }
    if is_gymnasium(what) {
        return format!("there is no preset `{what}`; did you mean {GYMNASIUM}{what}? Otherwise {all}");
    }
    match nearest(what, known) {
        Some(near) => format!("there is no preset `{what}`; did you mean {near}? Otherwise {all}"),
        None => format!("there is no preset `{what}`: {all}"),
    }
}

/// Whether this looks like the name of a Gymnasium environment, which ends in a version: `Pendulum-v1`.
pub(super) fn is_gymnasium(name: &str) -> bool {
    let version = name.rsplit_once("-v").map(|(_, version)| version);
    version.is_some_and(|version| !version.is_empty() && version.bytes().all(|byte| byte.is_ascii_digit()))
}

#[cfg(test)]
mod tests {
    use super::super::resolve::{resolve, resolve_preset};
    use super::*;
    use shoal_common::config::Mode;

    #[test]
    fn a_path_in_place_of_a_preset_is_told_what_it_is() {
        let place = tempfile::tempdir().unwrap();
        let refused = |name: &str| {
            let error = resolve_preset(place.path().join(name).to_str().unwrap()).unwrap_err();
            assert!(error.is::<UsageError>());
            let message = error.to_string();
            assert!(!message.contains('\n'), "{message}");
            message.replace(&format!("{}/", place.path().display()), "")
        };
        for directory in ["run", "suite", "other"] {
            std::fs::create_dir(place.path().join(directory)).unwrap();
        }
        for file in ["run/config.toml", "suite/suite.json", "x.json"] {
            std::fs::write(place.path().join(file), "").unwrap();
        }
        assert_eq!(
            refused("run"),
            "run is a run: to continue it, `shoal resume run`; to begin another one with its settings, `shoal train \
             run/config.toml`"
        );
        assert_eq!(
            refused("suite"),
            "suite is a suite of runs: to continue it, `shoal resume suite`"
        );
        for (name, start) in [
            ("other", "other is a directory without a run: choose pendulum, "),
            (
                "x.json",
                "x.json is a file whose name does not end in .toml: choose pendulum, ",
            ),
            (
                "none",
                "there is no preset, directory or file `none`: choose pendulum, ",
            ),
        ] {
            assert!(refused(name).starts_with(start), "{}", refused(name));
        }
    }

    #[test]
    fn an_algorithm_has_its_preset_for_the_task_or_its_own_defaults() {
        let with = |what: &str, algorithm: &str, set: &[&str]| {
            let overrides = RunOverrides {
                algorithm: (!algorithm.is_empty()).then(|| algorithm.into()),
                set: set.iter().map(|assignment| (*assignment).into()).collect(),
                ..RunOverrides::default()
            };
            resolve(what, &overrides).unwrap()
        };
        let (name, own) = with("pendulum", "sac", &[]);
        assert_eq!((name.as_str(), own.run.steps), ("pendulum-sac", 20_000));
        assert_eq!(with("pendulum", "", &["sac.tau=0.01"]).1.replay, own.replay);
        assert_eq!(with("pendulum-sac", "td3", &[]).0, "pendulum-td3");
        assert_eq!(with("pendulum-sac", "ddpg", &[]).0, "pendulum");
        assert_eq!(
            with("pendulum", "ddpg", &[]).1.algorithm,
            resolve_preset("pendulum").unwrap().algorithm
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
        assert_eq!(with("frozen-lake-sarsa", "q-learning", &[]).0, "frozen-lake");
        let (_, lake) = with("frozen-lake", "sarsa", &[]);
        assert_eq!((lake.algorithm.name(), lake.run.mode), ("sarsa", Mode::Lockstep));
    }
}
