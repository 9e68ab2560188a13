//! Completions for a shell: presets, configuration files, and the keys of the configuration with their values.

use std::ffi::OsStr;

use clap::{Arg, Command};
use clap_complete::CompleteEnv;
use clap_complete::engine::{ArgValueCompleter, CompletionCandidate, PathCompleter, ValueCompleter};
use shoal_common::config::explanation::{Key, sections, set_by_program};
use shoal_env_server::environment;
use shoal_run::external_environment::GYMNASIUM;
use shoal_run::plan::{is_configuration_file, preset_names};
use toml::{Table, Value};

/// The variable that a shell sets when it asks for completions. (Other programs may use plain `COMPLETE`.)
pub(crate) const VARIABLE: &str = "SHOAL_COMPLETE";

/// If a shell asks for completions, answers and ends the process. Otherwise does nothing.
pub(crate) fn answer(command: fn() -> Command) {
    let completed = || {
        // The declaration of this option is in a library that knows no completions.
        let set = |arg: Arg| arg.add(ArgValueCompleter::new(settings));
        command().mut_subcommand("train", |train| train.mut_arg("set", set))
    };
    CompleteEnv::with_factory(completed).var(VARIABLE).complete();
}

/// Presets, the prefix of Gymnasium environments, and configuration files.
pub(crate) fn presets_and_files(typed: &OsStr) -> Vec<CompletionCandidate> {
    let typed_text = typed.to_string_lossy();
    let names = preset_names()
        .chain([GYMNASIUM])
        .filter(|name| name.starts_with(typed_text.as_ref()));
    let files = PathCompleter::any()
        .filter(|path| path.is_dir() || is_configuration_file(path))
        .complete(typed);
    names.map(CompletionCandidate::new).chain(files).collect()
}

/// Keys of the configuration. After the `=`: the choices of the key, or its default.
pub(crate) fn settings(typed: &OsStr) -> Vec<CompletionCandidate> {
    let typed = typed.to_string_lossy();
    let settings = all_settings();
    let Some((typed_key, _)) = typed.split_once('=') else {
        let keys = settings
            .into_iter()
            .filter(|setting| setting.key.starts_with(typed.as_ref()));
        return keys
            .map(|setting| CompletionCandidate::new(format!("{}=", setting.key)).help(Some(setting.meaning.into())))
            .collect();
    };
    let mut assignments: Vec<String> = settings
        .into_iter()
        .filter(|setting| setting.key == typed_key)
        .flat_map(|setting| setting.values)
        .map(|value| format!("{typed_key}={value}"))
        .filter(|assignment| assignment.starts_with(typed.as_ref()))
        .collect();
    // Several environments may share a parameter.
    assignments.sort();
    assignments.dedup();
    assignments.into_iter().map(CompletionCandidate::new).collect()
}

struct Setting {
    /// `section.key`
    key: String,
    meaning: String,
    /// Its choices, or its default.
    values: Vec<String>,
}

fn all_settings() -> Vec<Setting> {
    let mut settings = Vec::new();
    for section in sections() {
        settings.extend(
            section
                .keys
                .iter()
                .map(|key| setting(section.name, key, &section.defaults)),
        );
    }
    for name in environment::names() {
        let defaults = environment::resolve(name, &Table::new()).unwrap_or_default();
        let keys = environment::explain(name).unwrap_or_default();
        settings.extend(keys.iter().map(|key| setting("environment", key, &defaults)));
    }
    let of_program = set_by_program();
    settings.retain(|setting| !of_program.contains(&setting.key));
    if let Some(name) = settings.iter_mut().find(|setting| setting.key == "environment.name") {
        name.values = environment::names().map(str::to_owned).collect();
    }
    let mut seen = std::collections::HashSet::new();
    let (first, again): (Vec<_>, Vec<_>) = settings
        .into_iter()
        .partition(|setting| seen.insert(setting.key.clone()));
    let mut settings = first;
    for other in again {
        if let Some(known) = settings.iter_mut().find(|known| known.key == other.key) {
            known.values.extend(other.values);
        }
    }
    settings
}

fn setting(section: &str, key: &Key, defaults: &Table) -> Setting {
    let default = defaults.get(&key.name).map(|value| match value {
        Value::String(word) => word.clone(),
        other => other.to_string().replace(' ', ""),
    });
    Setting {
        key: format!("{section}.{}", key.name),
        meaning: key.meaning.clone(),
        values: if key.choices.is_empty() {
            default.into_iter().collect()
        } else {
            key.choices.clone()
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(candidates: Vec<CompletionCandidate>) -> Vec<String> {
        let value = |candidate: &CompletionCandidate| candidate.get_value().to_string_lossy().into_owned();
        candidates.iter().map(value).collect()
    }

    #[test]
    fn presets_and_keys_are_completed() {
        let completed = values(presets_and_files(OsStr::new("point-mass-r3")));
        let presets: Vec<&str> = preset_names()
            .filter(|name| name.starts_with("point-mass-r3"))
            .collect();
        assert_eq!(completed, presets);
        assert_eq!(values(presets_and_files(OsStr::new("gy"))), ["gym:"]);
        assert_eq!(values(settings(OsStr::new("ddpg.ta"))), ["ddpg.tau="]);
        assert_eq!(
            values(settings(OsStr::new("environment.fric"))),
            ["environment.friction="]
        );
        assert_eq!(
            values(settings(OsStr::new("environment.time"))),
            ["environment.time_limit="]
        );
        assert!(values(settings(OsStr::new("run.i"))).is_empty(), "cannot be set");
    }

    #[test]
    fn choices_or_the_default_are_completed_after_the_equals_sign() {
        assert_eq!(values(settings(OsStr::new("ddpg.tau="))), ["ddpg.tau=0.001"]);
        assert_eq!(values(settings(OsStr::new("run.mode=l"))), ["run.mode=lockstep"]);
        assert_eq!(values(settings(OsStr::new("ddpg.hidden="))), ["ddpg.hidden=[400,300]"]);
        assert_eq!(
            values(settings(OsStr::new("ddpg.activation="))),
            ["ddpg.activation=relu", "ddpg.activation=tanh"]
        );
        assert_eq!(
            values(settings(OsStr::new("environment.name=p"))),
            ["environment.name=pendulum", "environment.name=point-mass"]
        );
    }
}
