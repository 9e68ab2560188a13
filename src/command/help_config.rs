//! `shoal train --help-config`: every key of the configuration, with its default, its unit and where that comes from.

use std::fmt::Write as _;
use std::io::Write as _;

use shoal_common::config::Config;
use shoal_common::config::explanation::{Key, sections};
use shoal_env_server::environment;
use shoal_run::plan::{FILLED_IN, preset_names, resolved};
use toml::{Table, Value};

/// Explains the keys of one preset or file, or where none is named, all that there are.
pub(crate) fn explain(what: Option<&str>) -> anyhow::Result<()> {
    let text = what.map_or_else(everything, of)?;
    std::io::stdout().lock().write_all(text.as_bytes())?;
    Ok(())
}

/// A key with its section, and what is known of it.
struct Entry {
    section: String,
    key: Key,
    default: Option<Value>,
}

/// Every key that a configuration may have, section after section; an environment's parameters stand under its name.
fn entries() -> anyhow::Result<Vec<(String, Vec<Entry>)>> {
    let mut all = Vec::new();
    for section in sections() {
        let entry = |key: Key| Entry {
            section: section.name.into(),
            default: section.defaults.get(&key.name).cloned(),
            key,
        };
        all.push((
            format!("[{}]", section.name),
            section.keys.into_iter().map(entry).collect(),
        ));
        if section.name == "environment" {
            for name in environment::names() {
                let defaults = environment::resolve(name, &Table::new())?;
                let entry = |key: Key| Entry {
                    section: "environment".into(),
                    default: defaults.get(&key.name).cloned(),
                    key,
                };
                let keys = environment::explain(name)?;
                all.push((
                    format!("[environment] of {name}"),
                    keys.into_iter().map(entry).collect(),
                ));
            }
        }
    }
    Ok(all)
}

const HEAD: &str = "\
Keys of a configuration, as --set SECTION.KEY=VALUE or in a FILE.toml. In brackets: the unit (– where there is none),
and the place in the thesis that the default comes from, or ours.
";

fn everything() -> anyhow::Result<String> {
    let preset = |name| Ok((name, table(&resolved(name)?)?));
    let presets = preset_names()
        .map(preset)
        .collect::<anyhow::Result<Vec<(&str, Table)>>>()?;
    let mut text = HEAD.to_owned();
    for (title, entries) in entries()? {
        let _ = writeln!(text, "\n{title}");
        for entry in entries {
            tell(&mut text, &entry.key, entry.default.as_ref());
            let of_environment = title.strip_prefix("[environment] of ");
            for (value, names) in differing(&presets, &entry, of_environment) {
                let _ = writeln!(text, "      {value} in {}", names.join(", "));
            }
        }
    }
    Ok(text)
}

/// Whether the program fills the key in for each run.
fn is_filled_in(section: &str, key: &Key) -> bool {
    FILLED_IN.contains(&format!("{section}.{}", key.name).as_str())
}

/// What presets have instead of the default, with their names.
fn differing<'a>(
    presets: &[(&'a str, Table)],
    entry: &Entry,
    environment: Option<&str>,
) -> Vec<(String, Vec<&'a str>)> {
    let mut differing: Vec<(String, Vec<&str>)> = Vec::new();
    if is_filled_in(&entry.section, &entry.key) {
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

fn of(what: &str) -> anyhow::Result<String> {
    let config = resolved(what)?;
    let table = table(&config)?;
    let mut text = format!("{HEAD}\n{what} is a configuration for {}.\n", config.algorithm.name());
    let environment = format!("[environment] of {}", config.environment.name);
    for (title, entries) in entries()? {
        let chosen = entries.iter().filter_map(|entry| {
            let value = table.get(&entry.section)?.as_table()?.get(&entry.key.name)?;
            // What the program fills in has no value to show.
            Some((&entry.key, (!is_filled_in(&entry.section, &entry.key)).then_some(value)))
        });
        let chosen: Vec<_> = chosen.collect();
        if chosen.is_empty() || (title.contains(" of ") && title != environment) {
            continue;
        }
        let _ = writeln!(text, "\n{title}");
        for (key, value) in chosen {
            tell(&mut text, key, value);
        }
    }
    Ok(text)
}

fn tell(text: &mut String, key: &Key, value: Option<&Value>) {
    let Key {
        name,
        meaning,
        unit,
        source,
        choices,
        bounds,
    } = key;
    let value = match value {
        Some(Value::String(word)) if word.is_empty() => String::new(),
        Some(value) => format!(" = {value}"),
        None => String::new(),
    };
    let _ = writeln!(text, "  {name}{value}  [{unit}; {source}]");
    let _ = writeln!(text, "      {meaning}");
    if !choices.is_empty() {
        let _ = writeln!(text, "      One of {}.", choices.join(", "));
    }
    if !bounds.is_empty() {
        let _ = writeln!(text, "      A number {bounds}.");
    }
}

fn table(config: &Config) -> anyhow::Result<Table> {
    Ok(Table::try_from(config)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A key that is new in a configuration and not explained ends up here.
    #[test]
    fn every_key_of_every_preset_is_explained() {
        let entries = entries().unwrap();
        for preset in preset_names() {
            let config = resolved(preset).unwrap();
            let environment = format!("[environment] of {}", config.environment.name);
            for (section, keys) in table(&config).unwrap() {
                // What the environment says of itself is nobody's to set.
                if section == "spec" {
                    continue;
                }
                for name in keys.as_table().unwrap().keys() {
                    let explained = entries.iter().flat_map(|(title, entries)| {
                        let here = !title.contains(" of ") || *title == environment;
                        entries.iter().filter(move |_| here)
                    });
                    let key = explained
                        .filter(|entry| entry.section == section && entry.key.name == *name)
                        .map(|entry| &entry.key)
                        .next();
                    let key = key.unwrap_or_else(|| panic!("{preset}: {section}.{name} is not explained"));
                    for part in [&key.meaning, &key.unit, &key.source] {
                        assert!(!part.is_empty(), "{preset}: {section}.{name} lacks something: {key:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn what_is_explained_is_a_key_and_has_words() {
        for (title, entries) in entries().unwrap() {
            assert!(!entries.is_empty(), "{title}");
            for Entry { key, .. } in entries {
                assert!(key.meaning.ends_with('.'), "{title} {}: {}", key.name, key.meaning);
                assert!(!key.unit.is_empty() && !key.source.is_empty(), "{title} {}", key.name);
            }
        }
    }

    #[test]
    fn a_presets_own_numbers_are_named() {
        let text = everything().unwrap();
        assert!(text.contains("steps = 120000  [environment steps;"), "{text}");
        assert!(text.contains("800000 in point-mass-r1"), "{text}");
        let lake = of("frozen-lake").unwrap();
        assert!(lake.contains("alpha = 0.03") && !lake.contains("tau"), "{lake}");
        assert!(lake.contains("warmup = 0 "), "{lake}");
    }
}
