//! Where each value of a configuration comes from.

use std::collections::BTreeMap;
use std::fmt::{self, Display, Formatter};

use shoal_common::algorithms::AlgorithmConfig;
use shoal_common::config::{ConfigError, OutOfRange, Subject};
use shoal_common::section::line_at;
use toml::de::{DeTable, DeValue};
use toml::{Table, Value};

use super::suggestion::with_suggestion;
use crate::usage::UsageError;

/// Where the value of a key comes from.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum SettingSource {
    /// No one has set the key.
    #[default]
    Default,
    /// The preset of this name.
    Preset(String),
    /// A line of this file.
    File(String, usize),
    /// The defaults for a Gymnasium environment.
    Gymnasium,
    /// The defaults for this algorithm, which was asked for.
    Algorithm(&'static str),
    /// This option of the command line.
    Option(&'static str),
    /// `--set`.
    Set,
    /// The value of something else, which this names.
    Follows(String),
    /// The run that is resumed has it.
    Run,
}

impl SettingSource {
    /// Whether the user has chosen the value.
    pub(super) fn is_from_user(&self) -> bool {
        matches!(self, Self::File(..) | Self::Option(_) | Self::Set)
    }
}

impl Display for SettingSource {
    fn fmt(&self, to: &mut Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => write!(to, "the default"),
            Self::Preset(name) => write!(to, "preset {name}"),
            Self::File(name, line) => write!(to, "{name}, line {line}"),
            Self::Gymnasium => write!(to, "the default for gym: environments"),
            Self::Algorithm(name) => write!(to, "the default for {name}"),
            Self::Option(option) => write!(to, "{option}"),
            Self::Set => write!(to, "--set"),
            Self::Follows(what) => write!(to, "follows from {what}"),
            Self::Run => write!(to, "the run's own"),
        }
    }
}

/// The sources of all keys, by `section.key`. A key that is not there has its default.
#[derive(Clone, Debug, Default)]
pub struct SettingSources(BTreeMap<String, SettingSource>);

/// The keys that bound the value of `key`. If `key` is refused, and the user has set one of these instead, the error
/// must name that one.
fn bounding(key: &str) -> Vec<String> {
    match key {
        "replay.warmup" => vec!["replay.capacity".into()],
        "replay.capacity" => AlgorithmConfig::all_with_minibatches()
            .map(|of| format!("{}.batch", of.name()))
            .collect(),
        "actors.count" => vec!["actors.max".into()],
        "actors.chunk_steps" => vec!["environment.time_limit".into()],
        _ => Vec::new(),
    }
}

impl SettingSources {
    /// All keys of `table` come from this preset.
    pub(super) fn of_preset(name: &str, table: &Table) -> Self {
        let mut sources = Self::default();
        sources.add(table, &SettingSource::Preset(name.into()));
        sources
    }

    /// The keys of a file of this name with their lines.
    pub(super) fn of_file(name: &str, text: &str) -> Self {
        let mut sources = Self::default();
        let Ok(document) = DeTable::parse(text) else {
            return sources;
        };
        for (section, value) in document.get_ref() {
            let at = |byte| SettingSource::File(name.into(), line_at(text, byte));
            let section_name = section.get_ref();
            sources.0.insert(format!("[{section_name}]"), at(section.span().start));
            if let DeValue::Table(keys) = value.get_ref() {
                for key in keys.keys() {
                    sources.set(format!("{section_name}.{}", key.get_ref()), at(key.span().start));
                }
            }
        }
        sources
    }

    /// Adds the keys of `now` that `before` does not have, except the environment's keys.
    pub(super) fn add_new(&mut self, before: &Table, now: &Table, source: &SettingSource) {
        for (section, keys) in now
            .iter()
            .filter(|(section, _)| !["environment", "spec"].contains(&section.as_str()))
        {
            for key in keys.as_table().into_iter().flat_map(Table::keys) {
                if before.get(section).and_then(|keys| keys.get(key)).is_none() {
                    self.set(format!("{section}.{key}"), source.clone());
                }
            }
        }
    }

    /// Adds the keys of `table` that have no source yet.
    pub(super) fn add(&mut self, table: &Table, source: &SettingSource) {
        for (section, keys) in table {
            for key in keys.as_table().into_iter().flat_map(Table::keys) {
                self.0
                    .entry(format!("{section}.{key}"))
                    .or_insert_with(|| source.clone());
            }
        }
    }

    pub(super) fn set(&mut self, key: String, source: SettingSource) {
        if let (SettingSource::Set, Some((section, _))) = (&source, key.split_once('.')) {
            self.0.entry(format!("[{section}]")).or_insert(SettingSource::Set);
        }
        self.0.insert(key, source);
    }

    /// The source of a key.
    pub fn of(&self, key: &str) -> SettingSource {
        self.0.get(key).cloned().unwrap_or_default()
    }

    /// The error for a refused configuration. It names what the user has set, and where.
    pub(super) fn explain(&self, error: &ConfigError, origin: &str, table: &Table) -> anyhow::Error {
        let message = with_suggestion(error.to_string());
        match error.subject() {
            Subject::Key(key) if key.starts_with("spec.") => {
                let of_environment = message.strip_prefix("spec.").unwrap_or(&message);
                anyhow::anyhow!("{origin}: the environment's {of_environment}")
            }
            Subject::Key(key) if self.of(&key).is_from_user() => self.error_naming_source(&key, &message),
            Subject::Key(_) => self
                .explain_bounding(error, table)
                .unwrap_or_else(|| self.explain_sections(&[], &message, origin)),
            Subject::Sections(names) => self.explain_sections(&names, &message, origin),
            Subject::Unknown => self.explain_sections(&[], &message, origin),
        }
    }

    /// The error for a key that the user may have set: names the option, or the file and the line.
    pub(super) fn error_naming_source(&self, key: &str, message: &str) -> anyhow::Error {
        match self.of(key) {
            SettingSource::Option(option) => UsageError(format!("{option}: {message}")).into(),
            SettingSource::Set => UsageError(message.into()).into(),
            SettingSource::File(name, line) => anyhow::anyhow!("{name}, line {line}: {message}"),
            SettingSource::Default
            | SettingSource::Preset(_)
            | SettingSource::Gymnasium
            | SettingSource::Algorithm(_)
            | SettingSource::Follows(_)
            | SettingSource::Run => {
                anyhow::anyhow!("{message}")
            }
        }
    }

    /// The same for a key that the user has not set, if the user has set one that bounds its value.
    fn explain_bounding(&self, error: &ConfigError, table: &Table) -> Option<anyhow::Error> {
        let ConfigError::OutOfRange(OutOfRange { key, value, expected }) = error else {
            return None;
        };
        let set = bounding(key).into_iter().find(|other| self.of(other).is_from_user())?;
        let set_value = set
            .split_once('.')
            .and_then(|(section, key)| table.get(section)?.get(key));
        let set_value = set_value.map_or_else(String::new, Value::to_string);
        let source = self.of(key);
        let advice = match source {
            SettingSource::Run => String::new(),
            _ => format!("; set {key} too"),
        };
        let text = format!(
            "{set} = {set_value}: does not go with {key} = {value} ({source}), which must be {expected}{advice}"
        );
        Some(self.error_naming_source(&set, &text))
    }

    /// The same for an error about whole sections, or about nothing that the user has named.
    fn explain_sections(&self, names: &[String], message: &str, origin: &str) -> anyhow::Error {
        let mut places = names.iter().map(|name| self.of(&format!("[{name}]")));
        match places.find(|place| *place != SettingSource::Default) {
            Some(SettingSource::File(name, line)) => anyhow::anyhow!("{name}, line {line}: {message}"),
            Some(_) => UsageError(message.into()).into(),
            None if self
                .0
                .values()
                .any(|source| matches!(source, SettingSource::Set | SettingSource::Algorithm(_))) =>
            {
                UsageError(format!("{origin}: {message}")).into()
            }
            None => anyhow::anyhow!("{origin}: {message}"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_keys_of_a_file_have_their_lines() {
        let text = "# a file\n[environment]\nname = \"pendulum\"\n\n[ddpg]\ntau = 0.5\nhidden = [\n1]\ngamma = 1\n";
        let sources = SettingSources::of_file("a.toml", text);
        for (key, line) in [
            ("environment.name", 3),
            ("ddpg.tau", 6),
            ("ddpg.hidden", 7),
            ("ddpg.gamma", 9),
        ] {
            assert_eq!(sources.of(key), SettingSource::File("a.toml".into(), line), "{key}");
        }
        assert_eq!(sources.of("run.steps"), SettingSource::Default);
    }
}
