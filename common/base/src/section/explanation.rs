//! Explanations of the configuration's keys. The text of a key is the doc comment of its field; unit, source and bounds
//! are attributes of the field.

use schemars::{JsonSchema, schema_for};
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value as Json;
use toml::{Table, Value};

use super::change::Change;
use super::{SectionError, read};

/// The explanation of a key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Key {
    /// The key within its section.
    pub name: String,
    /// Its meaning: whole sentences on one line.
    pub meaning: String,
    /// The unit of its numbers; `–` for pure numbers and for values that are not numbers.
    pub unit: String,
    /// Where its default comes from: a place in the thesis, or `ours`.
    pub source: String,
    /// Its possible values, if they can be listed.
    pub choices: Vec<String>,
    /// The bounds of its numbers, such as `from 0 to 1`; empty if none are declared.
    pub bounds: String,
    /// Whether it takes whole numbers.
    pub whole: bool,
    /// Whether it may change when a run is resumed; `None` for an environment's own parameters, which may not.
    pub change: Option<Change>,
}

/// A section of `config.toml`, without an environment's own parameters.
#[derive(Clone, Debug)]
pub struct Section {
    /// Its name.
    pub name: &'static str,
    /// Its keys.
    pub keys: Vec<Key>,
    /// The default values; some keys have none.
    pub defaults: Table,
    /// Reads a section of this name and type, and returns the error if that fails.
    pub check: fn(&str, Value) -> Result<(), SectionError>,
}

/// The section whose type is `T`.
pub fn describe<T: JsonSchema + Default + Serialize + DeserializeOwned>(name: &'static str) -> Section {
    Section {
        name,
        keys: keys::<T>(),
        // This cannot fail: every default is a number, a word or a list of them.
        defaults: Table::try_from(T::default()).unwrap_or_default(),
        check: |name, section| read::<T>(name, section).map(drop),
    }
}

/// The keys of a section whose type is `T`. A field is empty if the key's declaration has nothing for it.
pub fn keys<T: JsonSchema>() -> Vec<Key> {
    let schema = schema_for!(T).to_value();
    let text = |property: &Json, what: &str| property[what].as_str().unwrap_or_default().replace('\n', " ");
    let properties = schema["properties"].as_object().into_iter().flatten();
    let key = properties.map(|(name, property)| Key {
        name: name.clone(),
        meaning: text(property, "description"),
        unit: text(property, "unit"),
        source: text(property, "source"),
        choices: choices(&schema, property),
        bounds: text(property, "bounds"),
        whole: is_whole(&property["type"]),
        change: serde_json::from_value(property["change"].clone()).ok(),
    });
    key.collect()
}

/// Whether a value of this type is a whole number, or may be one.
fn is_whole(of_type: &Json) -> bool {
    let any = of_type.as_array().into_iter().flatten();
    std::iter::once(of_type).chain(any).any(|name| name == "integer")
}

/// The possible values of a property, if it is a word.
fn choices(schema: &Json, property: &Json) -> Vec<String> {
    if property["type"] == "boolean" {
        return vec!["false".into(), "true".into()];
    }
    let place = property["$ref"].as_str().and_then(|place| place.strip_prefix('#'));
    let Some(named) = place.and_then(|place| schema.pointer(place)) else {
        return Vec::new();
    };
    let words = |list: &Json, of: fn(&Json) -> Option<&str>| -> Vec<String> {
        let list = list.as_array().into_iter().flatten();
        list.filter_map(of).map(str::to_owned).collect()
    };
    let mut all = words(&named["enum"], Json::as_str);
    all.extend(words(&named["oneOf"], |one| one["const"].as_str()));
    all
}
