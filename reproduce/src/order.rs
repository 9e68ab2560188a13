//! What is asked for, and how it ends.

use std::path::PathBuf;

use super::experiment::{Effort, Experiment};
use super::family::Entry;

/// What is to be reproduced, and how.
#[derive(Clone, Debug)]
pub struct Order {
    /// Names of experiments; all of them where it is empty.
    pub experiments: Vec<String>,
    /// Seeds 1 to this one; as many as each experiment has by itself where it is none.
    pub seeds: Option<u32>,
    /// Trainings at a time.
    pub jobs: usize,
    /// How much of each experiment is run.
    pub effort: Effort,
    /// Where runs, results and figures lie.
    pub folder: PathBuf,
    /// Whether every figure is drawn as PNG as well as SVG.
    pub png: bool,
    /// The file that the report is written to.
    pub report: PathBuf,
}

/// How it went.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BatchEnding {
    /// Every result that was asked for is there.
    Complete,
    /// So many seeds have failed.
    Failed(usize),
    /// By this signal; every training has saved its state.
    Interrupted(i32),
}

/// One seed of one experiment, through all its stages.
#[derive(Clone, Copy, Debug)]
pub(super) struct Job {
    pub(super) family: &'static Entry,
    pub(super) experiment: &'static Experiment,
    pub(super) seed: u64,
}

/// What names a job.
pub(super) type Name = (&'static str, u64);

impl Job {
    pub(super) fn name(&self) -> Name {
        (self.experiment.name, self.seed)
    }
}
