//! The built-in configurations: the files of `presets/`.
//!
//! A preset has the name of its task. One for another algorithm than the task's first one has the name `TASK-ALGORITHM`.

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

pub(super) fn preset(name: &str) -> Option<(&'static str, &'static str)> {
    PRESETS.iter().copied().find(|(known, _)| *known == name)
}

#[cfg(test)]
mod tests {
    use super::super::overrides::RunOverrides;
    use super::super::resolve::decide;
    use super::*;
    use shoal_common::config::Config;

    fn plan(what: &str, set: &[&str]) -> anyhow::Result<Config> {
        let overrides = RunOverrides {
            set: set.iter().map(|assignment| (*assignment).into()).collect(),
            ..RunOverrides::default()
        };
        decide(what, &overrides).map(|(_, config)| config)
    }

    #[test]
    fn every_preset_is_a_configuration() {
        for name in preset_names() {
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
        for name in preset_names() {
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
        assert_eq!(all, include_str!("../../../tests/data/identity-1.txt"));
    }
}
