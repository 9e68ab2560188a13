//! The keys in which two configurations differ, and whether they may.

use std::collections::{BTreeMap, BTreeSet};

use shoal_base::section::{Change, never};
use toml::{Table, Value};

use super::environment::CHANGES_ROWS;
use super::{Config, explanation};

/// A key with different values in two configurations of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// The key with its section.
    pub key: String,
    /// Its values, as `--set` takes them; empty where there is none.
    pub before: String,
    /// As `before`.
    pub after: String,
    /// Whether it may change.
    pub change: Change,
}

impl Config {
    /// The keys in which `after`, another configuration of this run, differs, by name. If the algorithms differ,
    /// nothing else is named.
    pub fn differences(&self, after: &Self) -> Vec<Difference> {
        let algorithms = [self, after].map(|config| config.algorithm.name());
        if algorithms[0] != algorithms[1] {
            return vec![Difference {
                key: "the algorithm".into(),
                before: algorithms[0].into(),
                after: algorithms[1].into(),
                change: never("what one algorithm has learned is of no use to another"),
            }];
        }
        let [before, after] = [self, after].map(values);
        let names: BTreeSet<&String> = before.keys().chain(after.keys()).collect();
        let sections = explanation::sections();
        let difference = |key: &String| {
            let (before, after) = (before.get(key), after.get(key));
            (!are_same(before, after)).then(|| Difference {
                key: key.clone(),
                before: before.map_or_else(String::new, shown),
                after: after.map_or_else(String::new, shown),
                change: declared(&sections, key),
            })
        };
        names.into_iter().filter_map(difference).collect()
    }
}

impl Config {
    /// Every key with its section, and its value as `--set` takes it.
    pub fn values(&self) -> BTreeMap<String, String> {
        values(self)
            .iter()
            .map(|(key, value)| (key.clone(), shown(value)))
            .collect()
    }
}

/// Whether the key may change, by its declaration.
fn declared(sections: &[explanation::Section], key: &str) -> Change {
    let (section, name) = key.split_once('.').unwrap_or((key, ""));
    if section == "spec" {
        return never("the environment reports it");
    }
    let keys = sections.iter().filter(|known| known.name == section);
    let known = keys.flat_map(|section| &section.keys).find(|known| known.name == name);
    let declared = known.and_then(|known| known.change.clone());
    declared.unwrap_or_else(|| never(CHANGES_ROWS))
}

/// Every key with its section and value.
fn values(config: &Config) -> BTreeMap<String, Value> {
    // This cannot fail: the configuration has been read, or written before.
    let table = Table::try_from(config).unwrap_or_default();
    let mut all = BTreeMap::new();
    for (section, values) in table {
        if let Value::Table(values) = values {
            all.extend(
                values
                    .into_iter()
                    .map(|(key, value)| (format!("{section}.{key}"), value)),
            );
        }
    }
    all
}

fn shown(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        other => other.to_string(),
    }
}

/// Whether two values mean the same: `1` and `1.0` do, and so do two NaNs.
fn are_same(before: Option<&Value>, after: Option<&Value>) -> bool {
    let number = |value: &Value| {
        value
            .as_float()
            .or_else(|| value.as_integer().map(|whole| whole as f64))
    };
    match (before, after) {
        (Some(before), Some(after)) => {
            before.to_string() == after.to_string()
                || matches!((number(before), number(after)), (Some(before), Some(after)) if before == after)
        }
        (before, after) => before.is_none() && after.is_none(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Config {
        let rest = "[run]\nid = \"1a\"\n[spec]\ntime_limit = 200\nobservation.box = { low = [-1.0], high = [1.0] }\n\
            action.box = { low = [-2.0], high = [2.0] }\n";
        Config::from_table(format!("{rest}{text}").parse().unwrap(), "test").unwrap()
    }

    fn keys(before: &str, after: &str) -> Vec<String> {
        let differences = parse(before).differences(&parse(after));
        differences
            .into_iter()
            .map(|it| format!("{}: {} -> {}", it.key, it.before, it.after))
            .collect()
    }

    #[test]
    fn every_key_that_differs_is_named_with_both_values() {
        let environment = "[environment]\nname = \"x\"\nfriction = 1\nodd = [nan]\n";
        let other = "[environment]\nname = \"x\"\nfriction = 1.0\nodd = [nan]\n";
        assert_eq!(keys(environment, other), Vec::<String>::new());
        assert_eq!(
            keys(
                environment,
                "[environment]\nname = \"x\"\nfriction = 2\nwind = \"east\"\n[ddpg]\nhidden = [9]\ntau = 5e-3\n"
            ),
            [
                "ddpg.hidden: [400, 300] -> [9]",
                "ddpg.tau: 0.001 -> 0.005",
                "environment.friction: 1 -> 2",
                "environment.odd: [nan] -> ",
                "environment.wind:  -> east",
            ]
        );
        assert_eq!(
            keys(environment, &format!("{environment}[sac]\ntau = 0.1")),
            ["the algorithm: ddpg -> sac"]
        );
    }

    #[test]
    fn a_key_may_change_if_its_declaration_says_so() {
        let refused = |text: &str, lockstep: bool| {
            let name = "[environment]\nname = \"x\"\n";
            let differences = parse(name).differences(&parse(&format!("{name}{text}")));
            assert_eq!(differences.len(), 1, "{text}: {differences:?}");
            differences[0].change.refusal(lockstep).map(str::to_owned)
        };
        for (text, free, lockstep) in [
            ("[ddpg]\ntau = 0.5", true, true),
            ("[ddpg]\nbatch = 3", true, true),
            ("[evaluation]\nevery = 3", true, true),
            ("[exploration]\nsigma = 0.5", true, false),
            ("[actors]\ncount = 3", true, false),
            ("[actors]\nmax = 30", false, false),
            ("[replay]\nupdates_per_step = 3", true, false),
            ("[replay]\nupdates_before = 3", false, false),
            ("[replay]\nn_step = 3", false, false),
            ("[ddpg]\ngamma = 0.5", false, false),
            ("[ddpg]\nactivation = \"tanh\"", false, false),
            ("[observation]\nnormalise = true", false, false),
        ] {
            assert_eq!(refused(text, false).is_none(), free, "{text}");
            assert_eq!(refused(text, true).is_none(), lockstep, "{text}");
        }
        let wind = parse("[environment]\nname = \"x\"\nwind = 1\n");
        let calm = parse("[environment]\nname = \"x\"\nwind = 0\n");
        assert_eq!(wind.differences(&calm)[0].change, never(CHANGES_ROWS));
    }
}
