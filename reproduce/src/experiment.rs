//! An experiment is a preset with settings. Its results are stored at one or more milestones of its run.

use std::fmt::{self, Display};

use serde::{Deserialize, Serialize};
use shoal_run::numbers::thousands;

/// How much of each experiment is run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effort {
    /// As much as in the thesis.
    Full,
    /// Just enough to show that everything works.
    Quick,
}

/// An experiment; each of its seeds is one run directory.
#[derive(Debug)]
pub(super) struct Experiment {
    /// Its name in the folder.
    pub(super) name: &'static str,
    /// Its name on the command line. Experiments that differ only in a setting share one.
    pub(super) cli_name: &'static str,
    /// The preset to train.
    pub(super) preset: &'static str,
    /// Settings in addition to the preset, as SECTION.KEY=VALUE.
    pub(super) settings: &'static [&'static str],
    /// Further settings for a quick look.
    pub(super) quick: &'static [&'static str],
    /// Default number of seeds.
    pub(super) seeds: u32,
    /// Points of the same run at which results are stored, in ascending order of length.
    pub(super) milestones: &'static [Milestone],
}

/// A point of a run at which its result is stored.
#[derive(Debug)]
pub(super) struct Milestone {
    /// Distinguishes the results of an experiment's milestones; empty for the first milestone.
    pub(super) suffix: &'static str,
    /// Counted from the start of the run.
    pub(super) length: Length,
    /// The length in a quick look.
    pub(super) quick_length: Length,
}

/// The length of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Length {
    /// Environment steps.
    Steps(u64),
    /// Episodes.
    Episodes(u64),
}

/// The progress of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Progress {
    pub(super) steps: u64,
    pub(super) episodes: u64,
}

impl Length {
    /// How much of this length a run has done, and the length itself, both in its unit.
    pub(super) fn done_and_total(self, progress: Progress) -> (u64, u64) {
        match self {
            Self::Steps(steps) => (progress.steps, steps),
            Self::Episodes(episodes) => (progress.episodes, episodes),
        }
    }

    /// The arguments of `train` and `resume`.
    pub(super) fn arguments(self) -> [String; 2] {
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
    /// The settings of its runs, in addition to the preset.
    pub(super) fn settings(&self, effort: Effort) -> impl Iterator<Item = &'static str> {
        let quick: &[&str] = match effort {
            Effort::Full => &[],
            Effort::Quick => self.quick,
        };
        self.settings.iter().chain(quick).copied()
    }

    /// The number of seeds if the user gives none.
    pub(super) fn seeds(&self, effort: Effort) -> u32 {
        match effort {
            Effort::Full => self.seeds,
            Effort::Quick => 2,
        }
    }

    /// The length of a finished run, which is the length of its last milestone.
    pub(super) fn length(&self, effort: Effort) -> Option<Length> {
        self.milestones.last().map(|milestone| milestone.length(effort))
    }
}

impl Milestone {
    pub(super) fn length(&self, effort: Effort) -> Length {
        match effort {
            Effort::Full => self.length,
            Effort::Quick => self.quick_length,
        }
    }
}
