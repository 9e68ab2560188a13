//! What a figure is set beside: the machine's limit, and what it should be.

use serde::Serialize;

/// A row of the table.
#[derive(Debug, Serialize)]
pub(super) struct Line {
    pub(super) stage: &'static str,
    pub(super) ours: String,
    /// What the machine gives, measured in the same run; empty where there is no such figure.
    pub(super) limit: String,
    /// Ours over the limit.
    pub(super) share: Option<f64>,
    pub(super) target: Target,
}

/// What a figure should be.
#[derive(Debug, Serialize)]
pub(super) struct Target {
    text: &'static str,
    /// Whether it is; nothing where it is more a direction than a number.
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

    pub(super) fn none(text: &'static str) -> Self {
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
