//! The identity of a run: a text whose fingerprint is stored in the replay and the checkpoints. Files of another
//! identity are refused.
//!
//! The text has everything that the meaning of rows and weights depends on: the environment, its spaces, the algorithm,
//! the shapes of what it learns, seed, mode, γ, and the layout of a row. It does not have the run's id, learning rates,
//! exploration, evaluation, the run's length and its number of actors: those may differ when a run is resumed.
//!
//! The format of the text has a number, which is stored as `run.identity_format` when a run is created. A released
//! format never changes, because the files of old runs have its fingerprints. A change needs a new format with the next
//! number.

mod legacy;

use std::fmt::Write as _;

use sha2::{Digest, Sha256};
use shoal_base::space::Space;
use toml::{Table, Value};

use super::Config;
use super::identity_format::IdentityFormat;
use super::run::Mode;

impl Config {
    /// The identity: everything that the meaning of the replay's rows and a checkpoint's weights depends on.
    pub fn identity(&self) -> String {
        match self.run.identity_format {
            // Newer algorithms and networks have no unnumbered text.
            IdentityFormat::Unnumbered => legacy::text(self).unwrap_or_else(|| text(self)),
            IdentityFormat::One => text(self),
        }
    }

    /// The fingerprint of the [identity](Self::identity): the first eight bytes of its SHA-256.
    pub fn fingerprint(&self) -> u64 {
        let digest = Sha256::digest(self.identity().as_bytes());
        digest.iter().take(8).fold(0, |word, &byte| word << 8 | u64::from(byte))
    }
}

/// Format 1: one line for each property. A number has the fewest digits that identify it, without an exponent.
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
    for (name, shape) in config.learned_shapes().iter() {
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
    // What follows is named only if it differs from what every run had before there was a choice.
    if config.replay.n_step != 1 {
        line("steps of a row", &config.replay.n_step.to_string());
    }
    if config.reward.scale != 1.0 {
        line("reward scale", &config.reward.scale.to_string());
    }
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

/// The entries, sorted by name.
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

/// The text as a JSON string, in quotes.
fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

#[cfg(test)]
mod tests;
