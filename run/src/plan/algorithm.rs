//! The algorithm that the user asks for, and its defaults.

use anyhow::Context;
use shoal_common::algorithms::{AlgorithmConfig, AlgorithmProperties};
use toml::{Table, Value};

use crate::usage::UsageError;

/// Settings for single Gymnasium environments. `[ID.ALGORITHM]` has those that replace the algorithm's defaults; the
/// key `method` of `[ID]` names the algorithm that suits the environment best, if its spaces do not tell.
const OF_ENVIRONMENTS: &str = include_str!("../../../presets/method/environments.toml");

/// The key of an environment's best algorithm there.
const BEST: &str = "method";

/// The algorithms' names.
pub fn names() -> impl Iterator<Item = &'static str> {
    AlgorithmConfig::all().into_iter().map(|algorithm| algorithm.name())
}

/// The algorithm of this name.
pub(super) fn of_name(name: &str) -> Option<AlgorithmProperties> {
    let all = AlgorithmConfig::all().into_iter();
    all.map(|algorithm| algorithm.properties())
        .find(|known| known.name == name)
}

/// The algorithm that the user asks for: by its name, or by a key of its section.
///
/// # Errors
/// When there is no such algorithm, or two are asked for.
pub(crate) fn asked_for(algorithm: Option<&str>, set: &[String]) -> anyhow::Result<Option<&'static str>> {
    let known = |name: &str| of_name(name).map(|algorithm| algorithm.name);
    let by_name = match algorithm {
        None => None,
        Some(name) => Some(known(name).ok_or_else(|| {
            let names: Vec<&str> = names().collect();
            UsageError(format!(
                "--method {name}: there is no such algorithm; choose {}",
                names.join(", ")
            ))
        })?),
    };
    let sections = set.iter().filter_map(|assignment| assignment.split('.').next());
    let mut asked = by_name;
    for section in sections.filter_map(known) {
        if let Some(other) = asked.filter(|other| *other != section) {
            let two = format!("{other} and {section} are two algorithms, and a run has one: leave out one of them");
            return Err(UsageError(two).into());
        }
        asked = Some(section);
    }
    Ok(asked)
}

/// Makes a preset for another algorithm. What the preset says about learning was chosen for its own algorithm, so only
/// the environment, the run's length and the evaluation are kept. Returns what is kept.
pub(crate) fn replace(preset: &mut Table, algorithm: &'static str) -> anyhow::Result<Table> {
    preset.retain(|section, _| ["run", "environment", "evaluation"].contains(&section));
    if let Some(Value::Table(run)) = preset.get_mut("run") {
        run.remove("mode");
        // A preset that ends by episodes has steps only as an upper bound. The algorithm's own steps replace them.
        if run.contains_key("episodes") {
            run.remove("steps");
        }
    }
    let mut defaults = defaults(algorithm)?;
    // The preset's own length and evaluation suit its task.
    defaults.remove("evaluation");
    if preset.get("run").and_then(|run| run.get("steps")).is_some()
        && let Some(Value::Table(run)) = defaults.get_mut("run")
    {
        run.remove("steps");
    }
    let kept = preset.clone();
    add(preset, defaults);
    Ok(kept)
}

/// The algorithm that suits the Gymnasium environment `name` best, if its spaces do not tell.
pub(crate) fn best_for(name: &str) -> anyhow::Result<Option<&'static str>> {
    let of_environments: Table = OF_ENVIRONMENTS.parse()?;
    let best = of_environments.get(name).and_then(|own| own.get(BEST)?.as_str());
    Ok(best.and_then(of_name).map(|best| best.name))
}

/// Adds the defaults of an algorithm, and its defaults for the environment `name`, to a table. Existing settings are
/// kept.
pub(crate) fn add_defaults(table: &mut Table, name: &str, algorithm: &'static str) -> anyhow::Result<()> {
    let of_environments: Table = OF_ENVIRONMENTS.parse()?;
    let own = of_environments
        .get(name)
        .and_then(|algorithms| algorithms.get(algorithm));
    if let Some(Value::Table(own)) = own {
        add(table, own.clone());
    }
    add(table, defaults(algorithm)?);
    Ok(())
}

fn defaults(algorithm: &str) -> anyhow::Result<Table> {
    let found = of_name(algorithm).with_context(|| format!("there is no algorithm {algorithm}"))?;
    Ok(found.defaults.parse()?)
}

/// Adds the keys of `defaults` that the table does not have.
fn add(table: &mut Table, defaults: Table) {
    for (section, values) in defaults {
        let there = table.entry(section).or_insert_with(|| Table::new().into());
        if let (Value::Table(there), Value::Table(values)) = (there, values) {
            values.into_iter().for_each(|(key, value)| {
                there.entry(key).or_insert(value);
            });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_environment_may_have_numbers_of_its_own() {
        let mut table: Table = "[dqn]\nbatch = 32".parse().unwrap();
        add_defaults(&mut table, "gym:CartPole-v1", "dqn").unwrap();
        assert_eq!(table["dqn"]["batch"].as_integer(), Some(32), "what is set is kept");
        assert_eq!(table["dqn"]["epsilon_steps"].as_integer(), Some(8_000));
        assert_eq!(table["run"]["steps"].as_integer(), Some(50_000));
        let mut other = Table::new();
        add_defaults(&mut other, "gym:Other-v0", "dqn").unwrap();
        assert_eq!(other["run"]["steps"].as_integer(), Some(500_000));
        assert_eq!(best_for("gym:MountainCarContinuous-v0").unwrap(), Some("ddpg"));
        assert_eq!(best_for("gym:CartPole-v1").unwrap(), None);
    }

    #[test]
    fn every_algorithm_has_defaults_that_are_read_and_environments_name_algorithms() {
        for name in names() {
            assert!(defaults(name).unwrap().contains_key(name), "{name}");
        }
        let sections = shoal_common::config::explanation::sections();
        let is_key = |section: &str, key: &str| {
            let section = sections.iter().find(|known| known.name == section);
            section.is_some_and(|section| section.keys.iter().any(|known| known.name == key))
        };
        let of_environments: Table = OF_ENVIRONMENTS.parse().unwrap();
        for (environment, algorithms) in of_environments {
            for (algorithm, settings) in algorithms.as_table().unwrap() {
                if algorithm == BEST {
                    let best = best_for(&environment).unwrap();
                    assert!(algorithms.get(best.unwrap()).is_some(), "{environment}: {settings}");
                    continue;
                }
                assert!(of_name(algorithm).is_some(), "{environment}: {algorithm}");
                for (section, values) in settings.as_table().unwrap() {
                    for key in values.as_table().unwrap().keys() {
                        assert!(is_key(section, key), "{environment}.{algorithm}: {section}.{key}");
                    }
                }
            }
        }
    }
}
