//! A section of the configuration, each key declared once: its name and type, its default, its bounds, its unit, where the
//! default comes from, and what it means. Reading, validation, `--help-config` and completions all go by that declaration.

mod bounds;
mod explanation;

pub use bounds::{Bounded, Bounds, OutOfRange, above, from, in_words};
pub use explanation::{Key, Section, describe, keys};

use serde::de::{DeserializeOwned, Error};
use toml::{Table, Value};

/// Reads the section `name`, whose type is `T`; no key of it has to be there.
///
/// # Errors
/// When a key is unknown or of the wrong type. The error begins with the key and its value where it is that of one key.
pub fn read<T: DeserializeOwned>(name: &str, section: Value) -> Result<T, toml::de::Error> {
    // An error does not say of which key it is; so each is read alone, and what is wrong is found again.
    let alone = |(key, value): (&String, &Value)| {
        let only = Table::from_iter([(key.clone(), value.clone())]);
        let error = T::deserialize(only).err()?;
        Some(Error::custom(format!("{name}.{key} = {value}: {}", error.message())))
    };
    T::deserialize(section.clone()).map_err(|error| {
        let mut keys = section.as_table().into_iter().flatten();
        keys.find_map(alone).unwrap_or(error)
    })
}

/// Declares the struct of a section. A key is written as
///
/// ```text
/// /// What it means: whole sentences.
/// gamma: f64 = 0.99, bounds: from(0.0, 1.0), unit: "–", source: "section 4.3.1";
/// ```
///
/// `bounds` is left out where there is nothing to be compared (a word, `true` or `false`) or where the bounds are another
/// key's value; then the section's `check` or `Config::check` compares. The struct gets a default, serde's
/// and schemars' traits, and `check_bounds`.
#[macro_export]
macro_rules! section {
    (
        $(#[$attribute:meta])*
        pub struct $name:ident {
            $(
                $(#[$of_field:meta])*
                $field:ident: $type:ty = $default:expr
                $(, bounds: $bounds:expr)?
                $(, unit: $unit:literal, source: $source:literal)?;
            )*
        }
    ) => {
        $(#[$attribute])*
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
        #[serde(default, deny_unknown_fields)]
        pub struct $name {
            $(
                $(#[$of_field])*
                $(#[schemars(extend("unit" = $unit, "source" = $source))])?
                $(#[schemars(extend("bounds" = $crate::section::in_words::<$type>(&$bounds)))])?
                pub $field: $type,
            )*
        }

        impl Default for $name {
            fn default() -> Self {
                Self { $($field: $default),* }
            }
        }

        impl $name {
            /// Whether every number is within the bounds that are declared for it.
            ///
            /// # Errors
            /// For the first one that is not; `section` is the section's name in the configuration.
            pub fn check_bounds(&self, section: &str) -> Result<(), $crate::section::OutOfRange> {
                $($($crate::section::Bounded::check(&self.$field, section, stringify!($field), &$bounds)?;)?)*
                Ok(())
            }
        }
    };
}
