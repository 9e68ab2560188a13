//! The request to reproduce experiments, and its outcome.

use std::path::PathBuf;

use super::experiment::{Effort, Experiment};
use super::family::FamilyEntry;

/// What to reproduce, and how.
#[derive(Clone, Debug)]
pub struct Request {
    /// Command-line names of experiments; empty for all of them.
    pub experiments: Vec<String>,
    /// Run the seeds 1 to this one; by default each experiment's own number of seeds.
    pub seeds: Option<u32>,
    /// Number of trainings that run at the same time.
    pub parallel: usize,
    /// Full experiments or a quick look.
    pub effort: Effort,
    /// The directory of runs, results and figures.
    pub folder: PathBuf,
    /// Whether to draw every figure as PNG in addition to SVG.
    pub png: bool,
    /// The file of the report.
    pub report: PathBuf,
}

/// How a request ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReproductionEnd {
    /// Every requested result exists.
    Complete,
    /// This many seeds failed.
    Failed(usize),
    /// This signal was received; every training has saved its state.
    Interrupted(i32),
}

/// One seed of one experiment, with all its milestones.
#[derive(Clone, Copy, Debug)]
pub(super) struct Job {
    pub(super) family: &'static FamilyEntry,
    pub(super) experiment: &'static Experiment,
    pub(super) seed: u64,
}

/// The name of a job: experiment and seed.
pub(super) type JobName = (&'static str, u64);

impl Job {
    pub(super) fn name(&self) -> JobName {
        (self.experiment.name, self.seed)
    }
}
