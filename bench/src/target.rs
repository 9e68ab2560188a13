//! What a result is compared with: the machine's limit and a target.

use serde::Serialize;

/// A row of the table of `bench all`.
#[derive(Debug, Serialize)]
pub(super) struct TargetRow {
    pub(super) stage: &'static str,
    pub(super) ours: String,
    /// The machine's limit, measured in the same run; empty if there is none.
    pub(super) limit: String,
    /// Our result divided by the limit.
    pub(super) share: Option<f64>,
    pub(super) target: Target,
}

/// The target of a result.
#[derive(Debug, Serialize)]
pub(super) struct Target {
    text: &'static str,
    /// Whether the target is met; `None` if this measurement does not check it.
    met: Option<bool>,
}

impl Target {
    pub(super) fn at_least(least: f64, found: f64, text: &'static str) -> Self {
        Self {
            text,
            met: Some(found >= least),
        }
    }

    pub(super) fn at_most(most: f64, found: f64, text: &'static str) -> Self {
        Self {
            text,
            met: Some(found <= most),
        }
    }

    pub(super) fn unchecked(text: &'static str) -> Self {
        Self { text, met: None }
    }

    pub(super) fn show(&self) -> String {
        let verdict = match self.met {
            Some(true) => ": met",
            Some(false) => ": not met",
            None => "",
        };
        format!("{}{verdict}", self.text)
    }
}
