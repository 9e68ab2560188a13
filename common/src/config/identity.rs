//! What makes two runs the same run to the replay and the checkpoints: a text, of which both keep a fingerprint.
//!
//! In the text stands what the rows and the weights depend on by their meaning: the environment, its spaces, the algorithm, the
//! shapes of what it learns, seed, mode, γ, and a row's layout. Not in it stand the run's id, learning rates, exploration,
//! evaluation, the run's length and its number of actors: those may differ when a run goes on.
//!
//! The text's form has a number, which `run.identity_format` notes when a run is made. A form that has been released never
//! changes, because the files of old runs have its fingerprints; a change is a new form with the next number.

mod legacy;

use std::fmt::Write as _;

use sha2::{Digest, Sha256};
use shoal_base::space::Space;
use toml::{Table, Value};

use super::Config;
use super::identity_format::IdentityFormat;
use super::run::Mode;

impl Config {
    /// What the rows of the replay and the weights of a checkpoint depend on, as text.
    pub fn identity(&self) -> String {
        match self.run.identity_format {
            // An algorithm that came later has no older form.
            IdentityFormat::Unnumbered => legacy::text(self).unwrap_or_else(|| text(self)),
            IdentityFormat::One => text(self),
        }
    }

    /// A number for the [identity](Self::identity): the first eight bytes of its SHA-256.
    pub fn fingerprint(&self) -> u64 {
        let digest = Sha256::digest(self.identity().as_bytes());
        digest.iter().take(8).fold(0, |word, &byte| word << 8 | u64::from(byte))
    }
}

/// Form 1: a line for each thing. A number is written in the fewest digits that give it back, without an exponent.
fn text(config: &Config) -> String {
    let Config {
        run,
        environment,
        spec,
        algorithm,
        ..
    } = config;
    let mut text = String::from("shoal run, identity 1\n");
    let mut line = |what: &str, value: &str| {
        // Writing into a string cannot fail.
        let _ = writeln!(text, "{what}: {value}");
    };
    line("environment", &quoted(&environment.name));
    for (name, value) in sorted(&environment.parameters) {
        line(&format!("parameter {}", quoted(name)), &written(value));
    }
    line("observation", &space(&spec.observation));
    line("action", &space(&spec.action));
    line("time limit", &spec.time_limit.to_string());
    line("algorithm", algorithm.name());
    for (name, shape) in algorithm.settings().learned(spec).iter() {
        line(&format!("learned {name}"), &shape.to_string());
    }
    line("gamma", &algorithm.gamma().to_string());
    line("seed", &run.seed.to_string());
    line(
        "mode",
        match run.mode {
            Mode::Free => "free",
            Mode::Lockstep => "lockstep",
        },
    );
    let row = config.row_layout();
    let (observation, action) = (row.observation_width(), row.action_width());
    line(
        "row",
        &format!("s {observation}, a {action}, r 1, discount 1, s' {observation}, last 1"),
    );
    text
}

fn space(space: &Space) -> String {
    match space {
        Space::Box { low, high } => low
            .iter()
            .zip(high)
            .fold("box".into(), |text, (low, high)| text + &format!(" {low} .. {high}")),
        Space::Discrete { n, .. } => format!("discrete {n}"),
    }
}

/// The entries by their names, whatever order the table has.
fn sorted(table: &Table) -> Vec<(&String, &Value)> {
    let mut entries: Vec<_> = table.iter().collect();
    entries.sort_by_key(|(name, _)| *name);
    entries
}

fn written(value: &Value) -> String {
    match value {
        Value::String(text) => quoted(text),
        Value::Integer(number) => number.to_string(),
        Value::Float(number) => number.to_string(),
        Value::Boolean(truth) => truth.to_string(),
        Value::Datetime(time) => time.to_string(),
        Value::Array(values) => {
            let values: Vec<_> = values.iter().map(written).collect();
            format!("[{}]", values.join(", "))
        }
        Value::Table(table) => {
            let entry = |(name, value): (&String, &Value)| format!("{}: {}", quoted(name), written(value));
            let entries: Vec<_> = sorted(table).into_iter().map(entry).collect();
            format!("{{{}}}", entries.join(", "))
        }
    }
}

/// In quotes, as JSON has it.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

#[cfg(test)]
mod tests;
