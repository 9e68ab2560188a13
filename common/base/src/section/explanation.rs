//! What each key of a configuration means, in words. The words are the doc comments of the fields; unit, source and bounds
//! stand beside them as attributes.

use schemars::{JsonSchema, schema_for};
use serde::Serialize;
use serde_json::Value;
use toml::Table;

/// What is to be known of a key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key {
    /// The key within its section.
    pub name: String,
    /// What it is: whole sentences on one line.
    pub meaning: String,
    /// What a number of it counts or measures; `–` for a pure number and for what is no number.
    pub unit: String,
    /// Where its default comes from: a place in the thesis, or `ours`.
    pub source: String,
    /// What it may be, where that can be listed.
    pub choices: Vec<String>,
    /// What a number of it may be, as `from 0 to 1`; empty where no bounds are declared.
    pub bounds: String,
}

/// A section of `config.toml`, but for an environment's own parameters.
#[derive(Clone, Debug)]
pub struct Section {
    /// Its name.
    pub name: &'static str,
    /// Its keys.
    pub keys: Vec<Key>,
    /// What the keys are where nothing else is said; some have no default.
    pub defaults: Table,
}

/// The section whose type is `T`.
pub fn describe<T: JsonSchema + Default + Serialize>(name: &'static str) -> Section {
    Section {
        name,
        keys: keys::<T>(),
        // Every default is a number, a word or a list of them.
        defaults: Table::try_from(T::default()).unwrap_or_default(),
    }
}

/// The keys of a section whose type is `T`; what is not said of one is empty.
pub fn keys<T: JsonSchema>() -> Vec<Key> {
    let schema = schema_for!(T).to_value();
    let text = |property: &Value, what: &str| property[what].as_str().unwrap_or_default().replace('\n', " ");
    let properties = schema["properties"].as_object().into_iter().flatten();
    let key = properties.map(|(name, property)| Key {
        name: name.clone(),
        meaning: text(property, "description"),
        unit: text(property, "unit"),
        source: text(property, "source"),
        choices: choices(&schema, property),
        bounds: text(property, "bounds"),
    });
    key.collect()
}

/// The words that a property may be.
fn choices(schema: &Value, property: &Value) -> Vec<String> {
    if property["type"] == "boolean" {
        return vec!["false".into(), "true".into()];
    }
    let place = property["$ref"].as_str().and_then(|place| place.strip_prefix('#'));
    let Some(named) = place.and_then(|place| schema.pointer(place)) else {
        return Vec::new();
    };
    let words = |list: &Value, of: fn(&Value) -> Option<&str>| -> Vec<String> {
        let list = list.as_array().into_iter().flatten();
        list.filter_map(of).map(str::to_owned).collect()
    };
    let mut all = words(&named["enum"], Value::as_str);
    all.extend(words(&named["oneOf"], |one| one["const"].as_str()));
    all
}
