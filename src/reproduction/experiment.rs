//! What is run: an experiment is a preset with settings, in one or more stages.

/// How much is done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Effort {
    /// What the thesis did.
    Full,
    /// Just enough to see that everything works.
    Quick,
}

/// An experiment; each of its seeds is one run directory.
#[derive(Debug)]
pub(super) struct Experiment {
    /// Its name on the command line and in the folder.
    pub(super) name: &'static str,
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

/// A number of steps at which a run is looked at.
#[derive(Debug)]
pub(super) struct Stage {
    /// What the result's name ends in; empty for an experiment's first stage.
    pub(super) suffix: &'static str,
    /// Environment steps since the run's beginning.
    pub(super) steps: u64,
    /// The same for a quick look.
    pub(super) quick_steps: u64,
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

    /// Steps of a run that is through.
    pub(super) fn last_steps(&self, effort: Effort) -> u64 {
        self.stages.iter().map(|stage| stage.steps(effort)).max().unwrap_or(0)
    }
}

impl Stage {
    pub(super) fn steps(&self, effort: Effort) -> u64 {
        match effort {
            Effort::Full => self.steps,
            Effort::Quick => self.quick_steps,
        }
    }
}
