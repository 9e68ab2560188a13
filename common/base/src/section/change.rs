//! Whether a key may change after the start of its run.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

/// Whether a key may change when its run is resumed: part of the key's declaration.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Change {
    /// It may change at any time: what is learned from given rows does not depend on it.
    Anytime,
    /// It may change, but later updates depend on it. So a lockstep run must first have learned from all its complete
    /// rounds.
    Learning,
    /// It may change in a free run. In a lockstep run it may not, for this reason.
    InFreeRuns(Cow<'static, str>),
    /// It is part of the shape of a network, and never changes. A run that begins with the networks of another run
    /// takes it from there.
    Shape,
    /// It never changes, for this reason.
    Never(Cow<'static, str>),
    /// The program sets it itself.
    ByProgram,
}

/// A key that never changes, and why.
pub const fn never(why: &'static str) -> Change {
    Change::Never(Cow::Borrowed(why))
}

/// A key that may change in free runs, and why it may not in a lockstep run.
pub const fn in_free_runs(why: &'static str) -> Change {
    Change::InFreeRuns(Cow::Borrowed(why))
}

/// For keys of exploration. In a lockstep run some actors may already have collected their part of the next round; that
/// depends on timing.
pub const EXPLORATION: Change =
    in_free_runs("a part of its next round may have been collected with the old value, and that depends on timing");

impl Change {
    /// Why the key may not change; `None` if it may.
    pub fn refusal(&self, lockstep: bool) -> Option<&str> {
        match self {
            Self::Anytime | Self::Learning => None,
            Self::InFreeRuns(why) => lockstep.then_some(why),
            Self::Shape => Some("the networks keep their shapes"),
            Self::Never(why) => Some(why),
            Self::ByProgram => Some("the program sets it"),
        }
    }

    /// A sentence for the explanation of the key.
    pub fn in_words(&self) -> String {
        match self {
            Self::Anytime | Self::Learning => "May change when the run is resumed.".into(),
            Self::InFreeRuns(why) => format!("May change when a free run is resumed; not in lockstep: {why}."),
            Self::ByProgram => "Set by the program.".into(),
            Self::Shape | Self::Never(_) => {
                format!(
                    "Fixed when the run is created: {}.",
                    self.refusal(true).unwrap_or_default()
                )
            }
        }
    }
}
