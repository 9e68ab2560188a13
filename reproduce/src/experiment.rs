//! What is run: an experiment is a preset with settings, in one or more stages.

use std::fmt::{self, Display};

use serde::{Deserialize, Serialize};
use shoal_run::numbers::thousands;

/// How much is done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effort {
    /// What the thesis did.
    Full,
    /// Just enough to see that everything works.
    Quick,
}

/// An experiment; each of its seeds is one run directory.
#[derive(Debug)]
pub(super) struct Experiment {
    /// Its name in the folder.
    pub(super) name: &'static str,
    /// What it is asked for by on the command line: several that differ in a setting have one name there.
    pub(super) asked_as: &'static str,
    /// The preset to train.
    pub(super) preset: &'static str,
    /// SECTION.KEY=VALUE, beyond the preset.
    pub(super) settings: &'static [&'static str],
    /// The same, in addition, for a quick look.
    pub(super) quick: &'static [&'static str],
    /// How many seeds it has by itself.
    pub(super) seeds: u32,
    /// One after the other on the same run, each with more steps than the one before.
    pub(super) stages: &'static [Stage],
}

/// A point at which a run is looked at.
#[derive(Debug)]
pub(super) struct Stage {
    /// What the result's name ends in; empty for an experiment's first stage.
    pub(super) suffix: &'static str,
    /// Since the run's beginning.
    pub(super) length: Length,
    /// The same for a quick look.
    pub(super) quick_length: Length,
}

/// How long a run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Length {
    /// Environment steps.
    Steps(u64),
    /// Episodes.
    Episodes(u64),
}

/// How far a run is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Progress {
    pub(super) steps: u64,
    pub(super) episodes: u64,
}

impl Length {
    /// How much of it is done, and how much there is, in its own unit.
    pub(super) fn done(self, progress: Progress) -> (u64, u64) {
        match self {
            Self::Steps(steps) => (progress.steps, steps),
            Self::Episodes(episodes) => (progress.episodes, episodes),
        }
    }

    /// As `train` and `resume` take it.
    pub(super) fn argument(self) -> [String; 2] {
        match self {
            Self::Steps(steps) => ["--steps".into(), steps.to_string()],
            Self::Episodes(episodes) => ["--episodes".into(), episodes.to_string()],
        }
    }
}

impl Display for Length {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Steps(steps) => write!(f, "{} steps", thousands(*steps)),
            Self::Episodes(episodes) => write!(f, "{} episodes", thousands(*episodes)),
        }
    }
}

impl Experiment {
    /// The settings of all its runs.
    pub(super) fn settings(&self, effort: Effort) -> impl Iterator<Item = &'static str> {
        let quick: &[&str] = match effort {
            Effort::Full => &[],
            Effort::Quick => self.quick,
        };
        self.settings.iter().chain(quick).copied()
    }

    /// Seeds, where nobody says how many.
    pub(super) fn seeds(&self, effort: Effort) -> u32 {
        match effort {
            Effort::Full => self.seeds,
            Effort::Quick => 2,
        }
    }

    /// How long a run is that is through.
    pub(super) fn length(&self, effort: Effort) -> Option<Length> {
        self.stages.last().map(|stage| stage.length(effort))
    }
}

impl Stage {
    pub(super) fn length(&self, effort: Effort) -> Length {
        match effort {
            Effort::Full => self.length,
            Effort::Quick => self.quick_length,
        }
    }
}
