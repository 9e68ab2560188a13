//! Sections of the configuration. Each key is declared once: its name, type, default, bounds, unit and meaning, the source
//! of the default, and whether it may change after the start of a run. Reading, validation, `resume --set`,
//! `--help-config` and completions all follow from that declaration.

mod bounds;
mod change;
mod explanation;

pub use bounds::{Bounded, Bounds, OutOfRange, above, from, in_words};
pub use change::{Change, EXPLORATION, in_free_runs, never};
pub use explanation::{Key, Section, describe, keys};

use std::fmt::Display;

use serde::de::DeserializeOwned;
use toml::{Table, Value};

use crate::message::one_line;

/// Why a section cannot be read: a key is unknown or of the wrong type.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{message}")]
pub struct SectionError {
    /// The key at fault, with its section; `None` if not a single key is at fault.
    pub key: Option<String>,
    /// What is wrong, on one line. It begins with the key and its value, or with the section.
    pub message: String,
}

/// Reads the section `name`, whose type is `T`. Every key is optional.
///
/// # Errors
/// When a key is unknown or of the wrong type.
pub fn read<T: DeserializeOwned>(name: &str, section: Value) -> Result<T, SectionError> {
    // serde's error does not name the key, so each key is read alone to find the faulty one.
    let alone = |(key, value): (&String, &Value)| {
        let only = Table::from_iter([(key.clone(), value.clone())]);
        let error = T::deserialize(only).err()?;
        let reason = in_user_words(error.message());
        // The value is a list, and one of its items has the wrong type.
        let each = value.is_array() && reason != error.message();
        let each = if each { "each " } else { "" };
        let key = format!("{name}.{key}");
        Some(SectionError {
            message: refusal(&key, value, &format!("{each}{reason}")),
            key: Some(key),
        })
    };
    T::deserialize(section.clone()).map_err(|error| {
        let mut keys = section.as_table().into_iter().flatten();
        keys.find_map(alone).unwrap_or_else(|| SectionError {
            key: None,
            message: format!("[{name}]: {}", one_line(error.message())),
        })
    })
}

/// Rewords serde's message about a value of the wrong type, which names Rust types: the result says what the value must
/// be. Other messages are returned unchanged, on one line.
pub fn in_user_words(message: &str) -> String {
    let message = one_line(message);
    let of_type = message.starts_with("invalid type: ") || message.starts_with("invalid value: ");
    let Some((_, expected)) = message.rsplit_once(", expected ").filter(|_| of_type) else {
        return message;
    };
    let expected = match expected.trim() {
        "f64" | "f32" => "a number, such as 0.5",
        "u8" | "u16" | "u32" | "u64" | "usize" => "a whole number from 0 on, such as 100",
        "a boolean" => "true or false",
        "a sequence" => "a list, such as [64, 48] or [\"a\", \"b\"]",
        "a string" | "string or table" => "text",
        other => other,
    };
    format!("must be {expected}")
}

/// A key with its value and what is wrong with it, on one line, whatever the value is.
pub fn refusal(key: impl Display, value: &Value, reason: &str) -> String {
    format!("{key} = {value}: {reason}").replace(['\n', '\r'], " ")
}

/// What is wrong with a TOML text, on one line: where the text came from, the number and the text of the line, and the
/// reason.
pub fn malformed(origin: impl Display, text: &str, error: &toml::de::Error) -> String {
    let reason = one_line(error.message());
    let Some(start) = error.span().map(|span| span.start.min(text.len())) else {
        return format!("{origin}: {reason}");
    };
    let number = line_at(text, start);
    let line: String = text
        .lines()
        .nth(number - 1)
        .unwrap_or_default()
        .trim()
        .chars()
        .take(60)
        .collect();
    format!("{origin}, line {number} (`{line}`): {reason}")
}

/// The number of the line, from 1, of a byte of the text.
pub fn line_at(text: &str, byte: usize) -> usize {
    1 + text.bytes().take(byte).filter(|byte| *byte == b'\n').count()
}

/// Declares the struct of a section. A key is written as
///
/// ```text
/// /// What it means: whole sentences.
/// gamma: f64 = 0.99, bounds: from(0.0, 1.0), unit: "–", source: "section 4.3.1", change: never("rows were made with it");
/// ```
///
/// Leave out `bounds` for values that are not numbers, and where a bound is the value of another key; the section's
/// `check` or `Config::check` then compares. A field that is a section of its own has only that section's name:
///
/// ```text
/// /// What it means.
/// exploration: ExplorationConfig = ExplorationConfig::default(), section: "exploration";
/// ```
///
/// It is not a key: it is read and written elsewhere, but checked together with the keys. The struct gets `Default`, the
/// traits of serde and schemars, and `check_bounds`.
#[macro_export]
macro_rules! section {
    (
        $(#[$attribute:meta])*
        pub struct $name:ident {
            $(
                $(#[$of_field:meta])*
                $field:ident: $type:ty = $default:expr
                $(, bounds: $bounds:expr)?
                $(, unit: $unit:literal, source: $source:literal, change: $change:expr)?
                $(, section: $section:literal)?;
            )*
        }
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
        #[serde(default, deny_unknown_fields)]
        pub struct $name {
            $(
                $(#[$of_field])*
                $(#[schemars(extend("unit" = $unit, "source" = $source, "change" = $change))])?
                $(#[schemars(extend("bounds" = $crate::section::in_words::<$type>(&$bounds)))])?
                $(
                    #[doc = concat!("\n\nThis is the section `[", $section, "]`.")]
                    #[serde(skip)]
                    #[schemars(skip)]
                )?
                pub $field: $type,
            )*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default),* }
            }
        }

        impl $name {
            /// Checks that every number is within its declared bounds. `section` is the section's name in the
            /// configuration.
            ///
            /// # Errors
            /// For the first number that is not.
            pub fn check_bounds(&self, section: &str) -> Result<(), $crate::section::OutOfRange> {
                $(
                    $($crate::section::Bounded::check(&self.$field, section, stringify!($field), &$bounds)?;)?
                    $(self.$field.check_bounds($section)?;)?
                )*
                Ok(())
            }
        }
    };
}
