//! Decides the configuration of a new run: takes the sections of the preset or file, applies the command line, and sets
//! the keys that follow from both.

use std::path::Path;

use shoal_common::algorithms::TransitionUse;
use shoal_common::config::{ActorsConfig, AlgorithmConfig, Config, IdentityFormat, explanation};
use shoal_common::run_dir::RunDir;
use shoal_env_server::description::Description;
use toml::{Table, Value};

use super::environment::{about_environment, describe_environment};
use super::overrides::{RunOverrides, read_counts, set_key, set_options};
use super::sections::sections_for_algorithm;
use super::source::{SettingSource, SettingSources};
use super::table::{integer, put};
use crate::origin::{Origin, shapes};
use crate::signals::Interrupt;

/// The resolved configuration of a preset or a file, without overrides.
pub fn resolve_preset(what: &str) -> anyhow::Result<Config> {
    resolve(what, &RunOverrides::default()).map(|(_, config)| config)
}

/// The resolved configuration of a preset or a file with these overrides, and where each value comes from.
pub fn resolve_with_sources(what: &str, overrides: &RunOverrides) -> anyhow::Result<(Config, SettingSources)> {
    let resolved = resolve_all(what, overrides, Interrupt::default())?;
    Ok((resolved.config, resolved.sources))
}

/// The configuration of a preset or a file with these overrides, and the default name of its run. Creates nothing.
pub fn resolve(what: &str, overrides: &RunOverrides) -> anyhow::Result<(String, Config)> {
    resolve_interruptibly(what, overrides, Interrupt::default())
}

/// As [`resolve`], but a signal ends the wait for another program that serves the environment.
pub(crate) fn resolve_interruptibly(
    what: &str,
    overrides: &RunOverrides,
    interrupt: Interrupt,
) -> anyhow::Result<(String, Config)> {
    let resolved = resolve_all(what, overrides, interrupt)?;
    Ok((resolved.name, resolved.config))
}

/// A resolved configuration, with what was found out on the way.
pub(super) struct Resolved {
    /// The default name of its run.
    pub(super) name: String,
    pub(super) config: Config,
    sources: SettingSources,
    /// What another program that serves the environment says of it.
    pub(super) description: Option<Description>,
}

/// Resolves a preset or a file with these overrides. Creates nothing. A signal ends the wait for another program that
/// serves the environment.
pub(super) fn resolve_all(what: &str, overrides: &RunOverrides, interrupt: Interrupt) -> anyhow::Result<Resolved> {
    let (name, mut table, mut sources) = sections_for_algorithm(what, overrides)?;
    set_options(&mut table, &mut sources, overrides)?;
    for assignment in &overrides.set {
        set_key(&mut table, &mut sources, assignment)?;
    }
    read_counts(&mut table).map_err(|error| sources.explain(&error.into(), what, &table))?;
    // For more actors than the default of `actors.max`, raise it, but not beyond its bounds.
    if let Some(count) = integer(&table, "actors", "count")
        && count > i64::from(ActorsConfig::default().max)
        && table.get("actors").is_some_and(|actors| actors.get("max").is_none())
    {
        put(
            &mut table,
            &["actors", "max"],
            count.min(ActorsConfig::MAX_ACTORS.into()).into(),
        )?;
        sources.set("actors.max".into(), SettingSource::Follows("actors.count".into()));
    }
    // A file may be the configuration of another run.
    if let SettingSource::File(..) = sources.of("run.steps") {
        subtract_initial_rows(&mut table, Path::new(what))?;
    }
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
    let description =
        describe_environment(&mut table, interrupt).map_err(|error| about_environment(error, &sources))?;
    // That has added an algorithm's settings for a Gymnasium environment, and the environment's own defaults.
    sources.add_new(&chosen, &table, &SettingSource::Gymnasium);
    set_from_algorithm(&mut table, &mut sources)?;
    set_from_source_run(&mut table, &mut sources, overrides)?;
    if let Some(dataset) = overrides.absolute_dataset()? {
        put(&mut table, &["run", "demonstrations"], dataset.into())?;
    }
    let mut config = Config::from_settings(&table).map_err(|error| sources.explain(&error, what, &table))?;
    // A short run must end with an evaluation too.
    if config.run.steps < config.evaluation.every {
        config.evaluation.every = config.run.steps;
        sources.set("evaluation.every".into(), SettingSource::Follows("run.steps".into()));
    }
    set_from_length(&mut config, &mut sources);
    Ok(Resolved {
        name,
        config,
        sources,
        description,
    })
}

/// Subtracts the initial rows of the run whose configuration this file is from its steps, which count them too. A new
/// run with its settings has rows of its own, or none.
fn subtract_initial_rows(table: &mut Table, file: &Path) -> anyhow::Result<()> {
    let is_set = |key: &&str| table.get("run").is_some_and(|run| run.get(*key).is_some());
    if !["from", "demonstrations"].iter().any(is_set) {
        return Ok(());
    }
    let directory = file.parent().unwrap_or(Path::new(""));
    // `config/used.toml` of a run is one deeper.
    let run = match directory.file_name() {
        Some(name) if name == "config" => directory.parent().unwrap_or(Path::new("")),
        _ => directory,
    };
    if let Some(origin) = Origin::read(&RunDir::at(run))?
        && let Some(steps) = integer(table, "run", "steps")
    {
        put(
            table,
            &["run", "steps"],
            steps.saturating_sub_unsigned(origin.rows()).into(),
        )?;
    }
    Ok(())
}

/// Sets what follows from the run's length if it is left open.
pub(super) fn set_from_length(config: &mut Config, sources: &mut SettingSources) {
    if let Some(key) = config.algorithm.set_from_length(config.run.steps) {
        let key = format!("{}.{key}", config.algorithm.name());
        sources.set(key, SettingSource::Follows("run.steps".into()));
    }
}

/// Sets the keys that the algorithm determines. A value that the user has set is left; `Config::check` refuses a wrong
/// one.
fn set_from_algorithm(table: &mut Table, sources: &mut SettingSources) -> anyhow::Result<()> {
    let limit = integer(table, "spec", "time_limit");
    let Some(algorithm) = AlgorithmConfig::named_in(table) else {
        return Ok(());
    };
    let once = algorithm.transition_use != TransitionUse::Minibatches;
    let episodes = algorithm.transition_use == TransitionUse::Episodes;
    for (section, key, value) in [
        ("run", "mode", (!algorithm.off_policy).then(|| Value::from("lockstep"))),
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
        sources.set(name, SettingSource::Follows(algorithm.name.into()));
    }
    Ok(())
}

/// Sets the shapes of the networks of the `--from` run, and what else follows from it, except keys that the user has set.
fn set_from_source_run(
    table: &mut Table,
    sources: &mut SettingSources,
    overrides: &RunOverrides,
) -> anyhow::Result<()> {
    let Some((path, config)) = overrides.source_run()? else {
        return Ok(());
    };
    put(table, &["run", "from"], path.display().to_string().into())?;
    if !table.contains_key(config.algorithm.name()) {
        // Networks of another algorithm, which are refused later.
        return Ok(());
    }
    let more = config.algorithm.settings().inherited_setting();
    let more = more.map(|(key, value)| (config.algorithm.name(), key.to_owned(), value));
    for (section, key, value) in shapes(&config)?.into_iter().chain(more) {
        let name = format!("{section}.{key}");
        if !sources.of(&name).is_from_user() {
            put(table, &[section, &key], value)?;
            sources.set(name, SettingSource::Follows("--from".into()));
        }
    }
    Ok(())
}

/// The configuration with these values of `--set`.
#[cfg(test)]
pub(super) fn resolve_with(what: &str, set: &[&str]) -> anyhow::Result<Config> {
    let overrides = RunOverrides {
        set: set.iter().map(|assignment| (*assignment).into()).collect(),
        ..RunOverrides::default()
    };
    resolve(what, &overrides).map(|(_, config)| config)
}

#[cfg(test)]
mod tests {
    use super::*;

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
            let message = format!("{:#}", resolve_with(what, &set).unwrap_err());
            assert!(
                message.contains(part) && !message.contains('\n'),
                "{what} {set:?}: {message}"
            );
        }
    }
}
