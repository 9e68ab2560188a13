//! Every section that the user may write, with its keys.

use shoal_base::section::describe;
pub use shoal_base::section::{Change, Key, Section, keys};

use super::actors::ActorsConfig;
use super::checkpoint::CheckpointConfig;
use super::environment::EnvironmentConfig;
use super::evaluation::EvaluationConfig;
use super::learner::LearnerConfig;
use super::observation::ObservationConfig;
use super::remote::RemoteConfig;
use super::replay::ReplayConfig;
use super::reward::RewardConfig;
use super::run::RunConfig;
use crate::algorithms::{AlgorithmConfig, ExplorationConfig};

/// Every section that the user may write, including all algorithms' sections, but without an environment's own
/// parameters.
pub fn sections() -> Vec<Section> {
    let environment = Section {
        name: "environment",
        keys: keys::<EnvironmentConfig>(),
        defaults: toml::Table::new(),
        // Its parameters are the environment's own.
        check: |_, _| Ok(()),
    };
    let mut all = vec![
        describe::<RunConfig>("run"),
        environment,
        describe::<ActorsConfig>("actors"),
    ];
    all.extend(AlgorithmConfig::sections());
    all.extend([
        describe::<ExplorationConfig>("exploration"),
        describe::<ObservationConfig>("observation"),
        describe::<RewardConfig>("reward"),
        describe::<LearnerConfig>("learner"),
        describe::<ReplayConfig>("replay"),
        describe::<EvaluationConfig>("evaluation"),
        describe::<CheckpointConfig>("checkpoint"),
        describe::<RemoteConfig>("remote"),
    ]);
    all
}

/// The keys that the program sets itself, each with its section.
pub fn set_by_program() -> Vec<String> {
    let sections = sections().into_iter();
    let keys = sections.flat_map(|section| section.keys.into_iter().map(move |key| (section.name, key)));
    let of_program = keys.filter(|(_, key)| key.change == Some(Change::ByProgram));
    of_program
        .map(|(section, key)| format!("{section}.{}", key.name))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, DdpgConfig, ReinforceConfig};

    #[test]
    fn every_key_says_whether_it_may_change() {
        for section in sections() {
            for key in section.keys {
                assert!(key.change.is_some(), "{}.{}", section.name, key.name);
            }
        }
        assert_eq!(
            set_by_program(),
            [
                "run.demonstrations",
                "run.from",
                "run.id",
                "run.identity_format",
                "replay.ratio_since",
                "replay.updates_before"
            ]
        );
    }

    fn minimal() -> toml::Table {
        let text = "[run]\nid = \"1a\"\n[environment]\nname = \"x\"\n[spec]\ntime_limit = 200\n\
            observation.discrete.n = 16\naction.box = { low = [-2.0], high = [2.0] }\n";
        text.parse().unwrap()
    }

    /// The error for this value of a key; `None` if it is accepted.
    fn refused(section: &str, key: &str, value: toml::Value) -> Option<String> {
        let mut table = minimal();
        let own = table.entry(section).or_insert_with(|| toml::Table::new().into());
        own.as_table_mut().unwrap().insert(key.into(), value);
        Config::from_table(table, "test").err().map(|error| error.to_string())
    }

    #[test]
    fn every_section_that_is_written_is_explained() {
        let written = toml::Table::try_from(Config::from_table(minimal(), "test").unwrap()).unwrap();
        for name in written.keys().filter(|name| *name != "spec") {
            let explained = sections().iter().any(|section| section.name == name);
            assert!(explained, "common/src/config/explanation.rs: no line for {name}");
        }
    }

    #[test]
    fn an_error_names_section_and_key_and_every_number_is_checked() {
        for Section { name, keys, .. } in sections() {
            if name != "environment" {
                let error = refused(name, "nonsense", 1.into()).unwrap();
                assert!(error.contains(&format!("{name}.nonsense = 1")), "{error}");
            }
            // Every whole number is a seed.
            let bounded = |key: &&Key| !key.bounds.is_empty() && key.name != "seed";
            for key in keys.iter().filter(bounded) {
                // Some numbers have only a least value.
                let values = match key.whole {
                    true => vec![toml::Value::from(0), (1_i64 << 62).into()],
                    false => vec![f64::NAN.into()],
                };
                // 0 may be within the bounds, and another error follow.
                let mut errors = values.into_iter().filter_map(|value| refused(name, &key.name, value));
                let named = format!("{name}.{} = ", key.name);
                let found = errors.any(|error| error.contains(&named));
                assert!(found, "{name}.{} is not checked", key.name);
            }
        }
    }

    #[test]
    fn the_explanation_of_a_key_comes_from_its_declaration() {
        let ddpg = keys::<DdpgConfig>();
        let tau = ddpg.iter().find(|key| key.name == "tau").unwrap();
        assert_eq!(
            tau.meaning,
            "τ, the share by which the target networks move in one gradient step (equation 3.31)."
        );
        assert_eq!(
            (tau.unit.as_str(), tau.source.as_str(), tau.bounds.as_str()),
            ("–", "equation 3.31, section 4.3.1", "above 0 and at most 1")
        );
        let weight = keys::<ReinforceConfig>()
            .into_iter()
            .find(|key| key.name == "weight")
            .unwrap();
        assert_eq!(weight.choices, ["return", "normalised", "baseline"]);
        assert_eq!(weight.bounds, "");
        let mode = keys::<RunConfig>().into_iter().find(|key| key.name == "mode").unwrap();
        assert_eq!(mode.choices, ["free", "lockstep"]);
        assert!(
            ddpg.iter().all(|key| key.name != "exploration"),
            "exploration has its own section"
        );
    }
}
