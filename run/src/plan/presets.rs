//! The built-in configurations: the files of `presets/`.
//!
//! A preset has the name of its task. A preset for another algorithm than the task's first has the name
//! `TASK-ALGORITHM`, and is found by that name.

use shoal_common::config::AlgorithmConfig;
use toml::Table;

use crate::plan::algorithm;

/// The line of a preset in [`PRESETS`]: its name, and the text of `presets/NAME.toml`.
macro_rules! preset {
    ($name:literal) => {
        ($name, include_str!(concat!("../../../presets/", $name, ".toml")))
    };
}

/// Every preset, in the order in which messages and completions name them.
const PRESETS: &[(&str, &str)] = &[
    preset!("pendulum"),
    preset!("point-mass-r1"),
    preset!("point-mass-r2"),
    preset!("point-mass-r3"),
    preset!("frozen-lake"),
    preset!("frozen-lake-sarsa"),
    preset!("cart-pole"),
    preset!("pendulum-sac"),
    preset!("pendulum-td3"),
    preset!("point-mass-r1-sac"),
    preset!("point-mass-r1-td3"),
    preset!("point-mass-r2-sac"),
    preset!("point-mass-r2-td3"),
    preset!("point-mass-r3-sac"),
    preset!("point-mass-r3-td3"),
];

/// The presets' names.
pub fn preset_names() -> impl Iterator<Item = &'static str> {
    PRESETS.iter().map(|(name, _)| *name)
}

/// The tasks of the presets, each with the other algorithms that have a preset for it: `pendulum[-sac|-td3]`.
pub fn preset_patterns() -> String {
    let tasks = preset_names().filter(|name| task(name) == *name);
    let pattern = |name: &str| {
        let others = preset_names().filter(|other| *other != name && task(other) == name);
        let endings: Vec<&str> = others.filter_map(|other| other.strip_prefix(name)).collect();
        match endings.as_slice() {
            [] => name.to_owned(),
            endings => format!("{name}[{}]", endings.join("|")),
        }
    };
    tasks.map(pattern).collect::<Vec<_>>().join(", ")
}

/// The name of the preset for the task of the preset `name` and this algorithm, if there is one.
pub(super) fn with_algorithm(name: &str, algorithm: &str) -> Option<&'static str> {
    let task = task(name);
    let own = format!("{task}-{algorithm}");
    preset(&own)
        .or_else(|| preset(task).filter(|(_, text)| algorithm_in(text) == algorithm))
        .map(|(name, _)| name)
}

/// The name of a preset without its algorithm's name, if it ends with one.
fn task(name: &str) -> &str {
    let stem = |algorithm| name.strip_suffix(algorithm)?.strip_suffix('-');
    let mut stems = algorithm::names().filter_map(stem);
    stems.find(|stem| preset(stem).is_some()).unwrap_or(name)
}

/// The algorithm of a preset with this text.
fn algorithm_in(text: &str) -> &'static str {
    let table = text.parse::<Table>().unwrap_or_default();
    AlgorithmConfig::named_in(&table).map_or(AlgorithmConfig::default().name(), |named| named.name)
}

/// The preset of this name, with its text.
pub(super) fn preset(name: &str) -> Option<(&'static str, &'static str)> {
    PRESETS.iter().copied().find(|(known, _)| *known == name)
}

#[cfg(test)]
mod tests {
    use super::super::resolve::resolve_with;
    use super::*;
    use std::path::Path;

    #[test]
    fn every_preset_is_a_configuration() {
        for name in preset_names() {
            let config = resolve_with(name, &[]).unwrap();
            let parameters = &config.environment.parameters;
            let made = shoal_env_server::environment::make(&config.environment.name, &Table::new()).unwrap();
            let resolved = shoal_env_server::environment::resolve(&config.environment.name, parameters).unwrap();
            assert_eq!(parameters, &resolved, "{name}: every parameter is set");
            assert_eq!(config.spec.time_limit, made.spec().time_limit, "{name}");
        }
    }

    /// If this text changes, earlier runs cannot be resumed unless the identity format gets a new number.
    #[test]
    fn the_identity_of_every_preset_is_unchanged_since_its_release() {
        let mut all = String::new();
        for name in preset_names() {
            let config = resolve_with(name, &[]).unwrap();
            all += &format!("# {name}\n{}\n", config.identity());
            let other_rate = resolve_with(name, &["evaluation.every=77", "run.steps=1234"]).unwrap();
            assert_eq!(other_rate.identity(), config.identity(), "{name}");
            assert_ne!(
                resolve_with(name, &["run.seed=5"]).unwrap().identity(),
                config.identity(),
                "{name}"
            );
        }
        assert_eq!(all, include_str!("../../../tests/data/identity-1.txt"));
    }

    #[test]
    fn every_file_in_presets_has_its_line() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../presets");
        let files = std::fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path());
        let files = files.filter(|path| path.extension().is_some_and(|it| it == "toml"));
        let names: Vec<String> = files
            .map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned())
            .collect();
        for name in &names {
            assert!(
                preset(name).is_some(),
                "run/src/plan/presets.rs: the line `preset!(\"{name}\"),` is missing in PRESETS"
            );
        }
        assert_eq!(names.len(), PRESETS.len(), "a preset is listed twice");
    }

    #[test]
    fn a_preset_for_another_algorithm_is_found_by_its_name() {
        for name in preset_names() {
            let config = resolve_with(name, &[]).unwrap();
            let of_task = resolve_with(task(name), &[]).unwrap();
            assert_eq!(config.environment, of_task.environment, "{name} is for another task");
            let own = config.algorithm.name();
            if task(name) != name {
                assert_eq!(name, format!("{}-{own}", task(name)));
                assert_ne!(
                    own,
                    of_task.algorithm.name(),
                    "{name} is the preset of its task's first algorithm"
                );
            }
            assert_eq!(with_algorithm(task(name), own), Some(name), "{name} is for {own}");
        }
        assert_eq!(with_algorithm("frozen-lake-sarsa", "q-learning"), Some("frozen-lake"));
        assert_eq!(with_algorithm("cart-pole", "dqn"), None);
        assert_eq!(with_algorithm("mine.toml", "dqn"), None);
        let patterns = preset_patterns();
        assert!(patterns.starts_with("pendulum[-sac|-td3], "), "{patterns}");
        assert!(patterns.ends_with("frozen-lake[-sarsa], cart-pole"), "{patterns}");
    }
}
