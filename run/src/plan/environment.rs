//! The environment of a new run: its sections `[environment]` and `[spec]`.

use anyhow::bail;
use serde::de::DeserializeOwned;
use shoal_common::config::{AlgorithmConfig, EnvironmentConfig, RunConfig};
use shoal_common::section;
use shoal_env_server::description::Description;
use shoal_env_server::environment::{self, EnvironmentError};
use toml::{Table, Value};

use super::sections::is_gymnasium;
use super::source::SettingSources;
use super::suggestion::{nearest, with_suggestion};
use crate::external_environment::server_location::{LaunchContext, ServerLocation, hash_seed};
use crate::external_environment::{self, ExternalEnvironment, GYMNASIUM};
use crate::plan::algorithm;
use crate::signals::Interrupt;

/// Fills in `[spec]` from the environment. Adds every parameter of a built-in environment, and for a Gymnasium
/// environment the settings of a suitable algorithm if the configuration names none. Returns what another program that
/// serves the environment says of it. A signal ends the wait for that program.
pub(super) fn describe_environment(table: &mut Table, interrupt: Interrupt) -> anyhow::Result<Option<Description>> {
    let run = table.get("run");
    let mode = run
        .and_then(|run| run.get("mode"))
        .and_then(|mode| mode.clone().try_into().ok())
        .unwrap_or(RunConfig::default().mode);
    let seed = run.and_then(|run| run.get("seed")).and_then(Value::as_integer);
    let seed = seed.map_or(RunConfig::default().seed, i64::cast_unsigned);
    let Some(Value::Table(section)) = table.get_mut("environment") else {
        bail!("the section [environment] is missing: it must have a name");
    };
    let Some(Value::String(name)) = section.remove("name") else {
        bail!(
            "environment.name is missing: it must be one of {}, or start with {GYMNASIUM}",
            environment::names().collect::<Vec<_>>().join(", ")
        );
    };
    let server = take(section, "server")?.or_else(|| external_environment::default_command(&name));
    let (faults, start_seconds) = (take(section, "faults")?, take(section, "start_seconds")?);
    let configured = |name, server, parameters| {
        let mut environment = EnvironmentConfig::new(name, server, parameters);
        environment.faults = faults.unwrap_or(environment.faults);
        environment.start_seconds = start_seconds.unwrap_or(environment.start_seconds);
        environment
    };
    let (environment, spec, description) = if let Some(server) = server {
        let environment = configured(name, server, section.clone());
        let launch_context = LaunchContext {
            location: ServerLocation::here(&environment.server)?,
            hash_seed: hash_seed(mode, seed),
            picture_height: None,
        };
        let served = ExternalEnvironment::begin_in(&environment, 1, 0, launch_context, interrupt)?;
        (environment, served.spec().clone(), served.description()?)
    } else {
        let parameters = environment::resolve(&name, section)?;
        let spec = environment::make(&name, &parameters)?.spec();
        (configured(name, Vec::new(), parameters), spec, None)
    };
    let named = AlgorithmConfig::named_in(table);
    if environment.name.starts_with(GYMNASIUM) {
        let algorithm = match named {
            Some(named) => named.name,
            None => algorithm::best_for(&environment.name)?.unwrap_or_else(|| AlgorithmConfig::suitable(&spec)),
        };
        algorithm::add_defaults(table, &environment.name, algorithm)?;
    }
    table.insert("environment".into(), Value::try_from(environment)?);
    table.insert("spec".into(), Value::try_from(spec)?);
    Ok(description)
}

/// The error about an environment's own parameters, with the place where the user has set the wrong parameter.
pub(super) fn about_environment(error: anyhow::Error, sources: &SettingSources) -> anyhow::Error {
    let Some(of_environment) = error.downcast_ref::<EnvironmentError>() else {
        return error;
    };
    let (key, text) = match of_environment {
        EnvironmentError::UnknownName { name, .. } => {
            let near = nearest(name, environment::names()).map(str::to_owned);
            let near = Some(format!("{GYMNASIUM}{name}"))
                .filter(|_| is_gymnasium(name))
                .or(near);
            let hint = near.map_or_else(String::new, |near| format!("; did you mean {near}?"));
            ("name", format!("{of_environment}{hint}"))
        }
        EnvironmentError::Parameters { reason, .. } => {
            let before_value = reason.split_once(" = ").map(|(key, _)| key);
            let key = before_value.or_else(|| reason.split('`').nth(1)).unwrap_or_default();
            (key, with_suggestion(of_environment.to_string()))
        }
    };
    sources.error_naming_source(&format!("environment.{key}"), &text)
}

/// Takes a key of `[environment]` that is not a parameter of the environment.
fn take<T: DeserializeOwned>(section: &mut Table, key: &str) -> anyhow::Result<Option<T>> {
    let Some(value) = section.remove(key) else {
        return Ok(None);
    };
    let wrong = |error: toml::de::Error| {
        let reason = section::in_user_words(error.message());
        anyhow::anyhow!(section::refusal(format!("environment.{key}"), &value, &reason))
    };
    value.clone().try_into().map(Some).map_err(wrong)
}
