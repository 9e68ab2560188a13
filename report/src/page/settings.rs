//! A run's settings as lines of a table.

use shoal_common::config::{Config, explanation};

/// A key with its sections, as `--set` takes it, and its value.
pub(super) type Setting = (String, String);

/// Settings in which repetitions may differ.
const NOT_COMPARED: [&str; 3] = ["run.seed", "run.steps", "run.episodes"];

/// Keys that the program sets but in which runs may differ.
const ORIGIN: [&str; 2] = ["run.from", "run.demonstrations"];

/// All settings in the order of `config.toml`, except those that the program sets, apart from [`ORIGIN`].
pub(super) fn of(config: &Config) -> anyhow::Result<Vec<Setting>> {
    let table: toml::Table = config.to_toml()?.parse()?;
    let mut settings = Vec::new();
    flatten("", &table, &mut settings);
    let of_program = explanation::set_by_program();
    settings.retain(|(key, _)| !of_program.contains(key) || ORIGIN.contains(&key.as_str()));
    Ok(settings)
}

fn flatten(prefix: &str, table: &toml::Table, into: &mut Vec<Setting>) {
    for (key, value) in table {
        let key = format!("{prefix}{key}");
        match value {
            toml::Value::Table(table) => flatten(&format!("{key}."), table, into),
            toml::Value::String(text) => into.push((key, text.clone())),
            other => into.push((key, other.to_string())),
        }
    }
}

/// The settings that repetitions have in common.
pub(super) fn in_common(settings: &[Setting]) -> impl Iterator<Item = &Setting> {
    let counts = |(key, _): &&Setting| !NOT_COMPARED.contains(&key.as_str());
    settings.iter().filter(counts)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_run::testing::small;

    #[test]
    fn every_setting_is_listed_as_it_is_typed() {
        let (config, _) = small("name = \"point-mass\"\nreward = \"r2\"");
        let settings = of(&config).unwrap();
        for (key, value) in [
            ("environment.reward", "r2"),
            ("ddpg.hidden", "[4, 3]"),
            ("run.mode", "free"),
        ] {
            assert!(settings.contains(&(key.into(), value.into())), "{key}: {settings:?}");
        }
        assert!(!settings.iter().any(|(key, _)| key == "run.id"));
        assert!(!in_common(&settings).any(|(key, _)| key == "run.seed"));
    }
}
