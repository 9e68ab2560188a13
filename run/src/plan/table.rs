//! The tables that configurations are read from.

use anyhow::bail;
use toml::{Table, Value};

/// Sets a value; sections on the way are made.
///
/// # Errors
/// When a section on the way is a value.
pub(super) fn put(table: &mut Table, path: &[&str], value: Value) -> anyhow::Result<()> {
    match path {
        [] => Ok(()),
        [key] => {
            table.insert((*key).into(), value);
            Ok(())
        }
        [section, rest @ ..] => match table.entry(*section).or_insert_with(|| Table::new().into()) {
            Value::Table(inner) => put(inner, rest, value),
            _ => bail!("`{section}` is a value, not a section"),
        },
    }
}

/// The whole number of this key, if it has one.
pub(super) fn integer(table: &Table, section: &str, key: &str) -> Option<i64> {
    table.get(section)?.get(key)?.as_integer()
}
