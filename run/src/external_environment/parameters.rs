//! An environment's parameters as another program is told them: one JSON object.

use anyhow::bail;
use toml::{Table, Value};

/// Parameters in this table are parameters too, whatever their names: `name` and `server` are keys of `[environment]`.
const NESTED: &str = "parameters";

/// The parameters as JSON, as Python's `json` reads it: with `NaN`, `Infinity` and `-Infinity`, which JSON itself
/// lacks. TOML's dates and times are strings in RFC 3339's form.
///
/// # Errors
/// When a parameter is given twice.
pub(super) fn json(parameters: &Table) -> anyhow::Result<String> {
    let mut all = parameters.clone();
    if let Some(Value::Table(nested)) = parameters.get(NESTED) {
        all.remove(NESTED);
        for (name, value) in nested {
            if all.insert(name.clone(), value.clone()).is_some() {
                bail!("environment.{name} and environment.{NESTED}.{name} are the same parameter: remove one of them");
            }
        }
    }
    Ok(object(&all))
}

fn object(table: &Table) -> String {
    let entry = |(name, value): (&String, &Value)| format!("{}:{}", quoted(name), written(value));
    format!("{{{}}}", joined(table.iter().map(entry)))
}

fn written(value: &Value) -> String {
    match value {
        Value::String(text) => quoted(text),
        Value::Integer(number) => number.to_string(),
        Value::Float(number) if number.is_nan() => "NaN".into(),
        Value::Float(number) if number.is_infinite() => if *number > 0.0 { "Infinity" } else { "-Infinity" }.into(),
        Value::Float(number) => serde_json::Value::from(*number).to_string(),
        Value::Boolean(truth) => truth.to_string(),
        Value::Datetime(time) => quoted(&time.to_string()),
        Value::Array(values) => format!("[{}]", joined(values.iter().map(written))),
        Value::Table(table) => object(table),
    }
}

fn quoted(text: &str) -> String {
    serde_json::Value::from(text).to_string()
}

fn joined(parts: impl Iterator<Item = String>) -> String {
    parts.collect::<Vec<_>>().join(",")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn json_of(toml: &str) -> String {
        json(&toml.parse().unwrap()).unwrap()
    }

    #[test]
    fn every_value_of_toml_has_a_text_that_python_reads() {
        for (toml, expected) in [
            ("", "{}"),
            ("rope = 4.0", r#"{"rope":4.0}"#),
            ("n = -3\nfast = true", r#"{"fast":true,"n":-3}"#),
            (r#"text = "a \"ü\"\n""#, r#"{"text":"a \"ü\"\n"}"#),
            ("tiny = 1e-300", r#"{"tiny":1e-300}"#),
            (
                "a = inf\nb = -inf\nc = [nan, 1.5]",
                r#"{"a":Infinity,"b":-Infinity,"c":[NaN,1.5]}"#,
            ),
            ("day = 1979-05-27", r#"{"day":"1979-05-27"}"#),
            (
                "at = [1979-05-27T07:32:00Z, 07:32:00]",
                r#"{"at":["1979-05-27T07:32:00Z","07:32:00"]}"#,
            ),
            ("[inner]\nday = 1979-05-27", r#"{"inner":{"day":"1979-05-27"}}"#),
        ] {
            assert_eq!(json_of(toml), expected, "{toml}");
        }
    }

    #[test]
    fn names_that_are_keys_of_the_section_can_be_parameters() {
        let merged = json_of("rope = 1\n[parameters]\nname = \"x\"\nserver = []\nparameters = 2");
        assert_eq!(merged, r#"{"name":"x","parameters":2,"rope":1,"server":[]}"#);
        assert_eq!(
            json_of("parameters = 5"),
            r#"{"parameters":5}"#,
            "no table: a parameter like any other"
        );
        let twice = json(&"rope = 1\n[parameters]\nrope = 2".parse().unwrap()).unwrap_err();
        assert!(twice.to_string().contains("environment.parameters.rope"), "{twice}");
    }
}
