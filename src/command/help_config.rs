//! `shoal train --help-config`: every key of the configuration, with its default, its unit and its source.

use std::fmt::Write as _;
use std::io::Write as _;

use shoal_common::config::Config;
use shoal_common::config::explanation::{Change, Key, sections};
use shoal_env_server::environment;
use shoal_run::plan::{RunOverrides, SettingSource, preset_names, resolve_preset, resolve_with_sources};
use toml::{Table, Value};

/// Explains the keys of one preset or file with these overrides, or all keys if none is named.
pub(crate) fn explain(what: Option<&str>, overrides: &RunOverrides) -> anyhow::Result<()> {
    let text = what.map_or_else(explain_all, |what| explain_one(what, overrides))?;
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(())
}

/// A key with its section and its default.
struct Entry {
    section: String,
    key: Key,
    default: Option<Value>,
}

/// The keys of a section, or the parameters of an environment.
struct Group {
    section: &'static str,
    /// The environment whose parameters these are.
    environment: Option<&'static str>,
    entries: Vec<Entry>,
}

impl Group {
    fn title(&self) -> String {
        let environment = self.environment.map_or(String::new(), |name| format!(" of {name}"));
        format!("[{}]{environment}", self.section)
    }

    /// Whether a run in this environment may have these keys.
    fn is_for(&self, environment: &str) -> bool {
        self.environment.is_none_or(|own| own == environment)
    }
}

/// Every key of a configuration.
fn groups() -> anyhow::Result<Vec<Group>> {
    let mut all = Vec::new();
    for section in sections() {
        let entry = |key: Key| Entry {
            section: section.name.into(),
            default: section.defaults.get(&key.name).cloned(),
            key,
        };
        all.push(Group {
            section: section.name,
            environment: None,
            entries: section.keys.into_iter().map(entry).collect(),
        });
        if section.name == "environment" {
            for name in environment::names() {
                let defaults = environment::resolve(name, &Table::new())?;
                let entry = |key: Key| Entry {
                    section: "environment".into(),
                    default: defaults.get(&key.name).cloned(),
                    key,
                };
                let keys = environment::explain(name)?;
                all.push(Group {
                    section: "environment",
                    environment: Some(name),
                    entries: keys.into_iter().map(entry).collect(),
                });
            }
        }
    }
    Ok(all)
}

const HEAD: &str = "\
The keys of a configuration, for --set SECTION.KEY=VALUE or a FILE.toml. In brackets: the unit (– if there is none), and
the source of the default: a place in the thesis, a paper or program, or ours.
";

fn explain_all() -> anyhow::Result<String> {
    let preset = |name| Ok((name, table(&resolve_preset(name)?)?));
    let presets = preset_names()
        .map(preset)
        .collect::<anyhow::Result<Vec<(&str, Table)>>>()?;
    let mut text = HEAD.to_owned();
    for group in groups()? {
        let _ = writeln!(text, "\n{}", group.title());
        for entry in &group.entries {
            write_key(&mut text, &entry.key, entry.default.as_ref(), None);
            for (value, names) in differing(&presets, entry, group.environment) {
                let _ = writeln!(text, "      {value} in {}", names.join(", "));
            }
        }
    }
    Ok(text)
}

/// Whether the program sets the key itself for each run.
fn is_filled_in(key: &Key) -> bool {
    key.change == Some(Change::ByProgram)
}

/// The values that differ from the default, each with the presets that have it.
fn differing<'a>(
    presets: &[(&'a str, Table)],
    entry: &Entry,
    environment: Option<&str>,
) -> Vec<(String, Vec<&'a str>)> {
    let mut differing: Vec<(String, Vec<&str>)> = Vec::new();
    if is_filled_in(&entry.key) {
        return differing;
    }
    for (name, table) in presets {
        let Some(section) = table.get(&entry.section).and_then(Value::as_table) else {
            continue;
        };
        if environment.is_some_and(|environment| section["name"].as_str() != Some(environment)) {
            continue;
        }
        let Some(value) = section
            .get(&entry.key.name)
            .filter(|value| Some(*value) != entry.default.as_ref())
        else {
            continue;
        };
        let value = value.to_string();
        match differing.iter_mut().find(|(known, _)| *known == value) {
            Some((_, names)) => names.push(*name),
            None => differing.push((value, vec![*name])),
        }
    }
    differing
}

fn explain_one(what: &str, overrides: &RunOverrides) -> anyhow::Result<String> {
    let (config, sources) = resolve_with_sources(what, overrides)?;
    let table = table(&config)?;
    let mut text = format!(
        "{HEAD}After the brackets: where the value comes from.\n\n{what} is a configuration for {}.\n",
        config.algorithm.name()
    );
    let of_run = |group: &Group| group.is_for(&config.environment.name);
    for group in groups()?.into_iter().filter(of_run) {
        let chosen = group.entries.iter().filter_map(|entry| {
            let value = table.get(&entry.section)?.as_table()?.get(&entry.key.name)?;
            // A key that the program sets has no value to show.
            let shown = (!is_filled_in(&entry.key)).then_some(value);
            let source = sources.of(&format!("{}.{}", entry.section, entry.key.name));
            Some((&entry.key, shown, shown.map(|_| source)))
        });
        let chosen: Vec<_> = chosen.collect();
        if chosen.is_empty() {
            continue;
        }
        let _ = writeln!(text, "\n{}", group.title());
        for (key, value, source) in chosen {
            write_key(&mut text, key, value, source.as_ref());
        }
    }
    Ok(text)
}

fn write_key(text: &mut String, key: &Key, value: Option<&Value>, source_of_value: Option<&SettingSource>) {
    let Key {
        name,
        meaning,
        unit,
        source,
        choices,
        bounds,
        whole: _,
        change,
    } = key;
    let number = match value {
        Some(Value::Array(_)) => "Each a number",
        _ => "A number",
    };
    let value = match value {
        Some(Value::String(word)) if word.is_empty() => String::new(),
        Some(value) => format!(" = {value}"),
        None => String::new(),
    };
    let from = source_of_value.map_or_else(String::new, |source| format!("  {source}"));
    let _ = writeln!(text, "  {name}{value}  [{unit}; {source}]{from}");
    let _ = writeln!(text, "      {meaning}");
    if !choices.is_empty() {
        let _ = writeln!(text, "      One of {}.", choices.join(", "));
    }
    if !bounds.is_empty() {
        let _ = writeln!(text, "      {number} {bounds}.");
    }
    if let Some(change) = change {
        let _ = writeln!(text, "      {}", change.in_words());
    }
}

fn table(config: &Config) -> anyhow::Result<Table> {
    Ok(Table::try_from(config)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fails for a new key without an explanation.
    #[test]
    fn every_key_of_every_preset_is_explained() {
        let groups = groups().unwrap();
        for preset in preset_names() {
            let config = resolve_preset(preset).unwrap();
            let of_run = |group: &&Group| group.is_for(&config.environment.name);
            for (section, keys) in table(&config).unwrap() {
                // The environment's description is not set by the user.
                if section == "spec" {
                    continue;
                }
                for name in keys.as_table().unwrap().keys() {
                    let explained = groups.iter().filter(of_run).flat_map(|group| &group.entries);
                    let key = explained
                        .filter(|entry| entry.section == section && entry.key.name == *name)
                        .map(|entry| &entry.key)
                        .next();
                    let key = key.unwrap_or_else(|| panic!("{preset}: {section}.{name} is not explained"));
                    for part in [&key.meaning, &key.unit, &key.source] {
                        assert!(!part.is_empty(), "{preset}: {section}.{name} is incomplete: {key:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn every_explanation_has_a_meaning_a_unit_and_a_source() {
        for group in groups().unwrap() {
            let title = group.title();
            assert!(!group.entries.is_empty(), "{title}");
            for Entry { key, .. } in group.entries {
                assert!(key.meaning.ends_with('.'), "{title} {}: {}", key.name, key.meaning);
                assert!(!key.unit.is_empty() && !key.source.is_empty(), "{title} {}", key.name);
            }
        }
    }

    #[test]
    fn values_of_presets_that_differ_from_the_default_are_shown() {
        let text = explain_all().unwrap();
        assert!(text.contains("steps = 120000  [environment steps;"), "{text}");
        assert!(text.contains("800000 in point-mass-r1"), "{text}");
        assert!(text.contains("      Each a number from 1 to 8192.\n"), "{text}");
        let lake = explain_one("frozen-lake", &RunOverrides::default()).unwrap();
        assert!(lake.contains("alpha = 0.03") && !lake.contains("tau"), "{lake}");
        assert!(lake.contains("warmup = 0 "), "{lake}");
    }

    #[test]
    fn each_value_of_a_configuration_names_its_source() {
        let parent = tempfile::tempdir().unwrap();
        let file = parent.path().join("mine.toml");
        std::fs::write(
            &file,
            "[environment]\nname = \"frozen-lake\"\n[q-learning]\nalpha = 0.5\n",
        )
        .unwrap();
        let file = file.display().to_string();
        let overrides = RunOverrides {
            actors: Some(20),
            set: vec!["q-learning.gamma=0.5".into()],
            ..RunOverrides::default()
        };
        let text = explain_one(&file, &overrides).unwrap();
        for (key, source) in [
            ("alpha = 0.5", format!("{file}, line 4")),
            ("gamma = 0.5", "--set".into()),
            ("count = 20", "--actors".into()),
            ("max = 20", "follows from actors.count".into()),
            ("warmup = 0", "follows from q-learning".into()),
            ("epsilon = 0.4", "the default".into()),
        ] {
            let line = text.lines().find(|line| line.trim_start().starts_with(key));
            assert!(
                line.is_some_and(|line| line.ends_with(&format!("]  {source}"))),
                "{key}: {line:?}"
            );
        }
        let preset = explain_one("pendulum", &RunOverrides::default()).unwrap();
        let line = preset.lines().find(|line| line.contains("steps = 120000")).unwrap();
        assert!(line.ends_with("]  preset pendulum"), "{line}");
    }
}
