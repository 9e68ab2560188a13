//! Learning from the replay: minibatches drawn at random from its newest rows (line 11 of Algorithm 4).

use nalgebra::DVector;
use shoal_common::policy::PolicyLayout;
use shoal_common::space::EnvironmentSpec;
use shoal_common::transition::RowLayout;

use super::algorithm::{Algorithm, Losses, RunSizes, SavedState, Section, SectionError, SectionMut};
use super::minibatch::Minibatch;
use super::sampling::Sampler;
use crate::networks::threads::Threads;
use crate::replay::Replay;

/// A learner that takes gradient steps with minibatches, wherever those come from.
pub trait MinibatchLearner {
    /// The policy's parameters.
    fn policy(&self) -> &[f32];

    /// The layout of the policy's parameters.
    fn layout(&self) -> PolicyLayout;

    /// Gradient steps taken.
    fn updates(&self) -> u64;

    /// Shares the work of a gradient step among these threads from now on, if there is enough of it. The bits of the
    /// results do not depend on them.
    fn set_threads(&mut self, threads: Threads);

    /// Takes a gradient step. Nothing is allocated. Panics if the batch has other dimensions than the networks and
    /// settings.
    fn learn(&mut self, batch: &Minibatch) -> Losses;

    /// Everything that the next gradient step depends on besides the batch, by name.
    fn state(&self) -> Vec<Section<'_>>;

    /// The same numbers, to be overwritten with those of a learner after `updates` gradient steps.
    fn state_mut(&mut self, updates: u64) -> Vec<SectionMut<'_>>;
}

/// A learner with its sampling from the replay.
#[derive(Debug)]
pub struct Replayed<L> {
    learner: L,
    sampler: Sampler,
    batch: Minibatch,
    indices: Vec<u64>,
    capacity: u64,
}

impl<L: MinibatchLearner> Replayed<L> {
    /// Samples minibatches of `batch` transitions in environments like `spec` for `learner`.
    pub fn new(learner: L, spec: &EnvironmentSpec, batch: usize, seed: u64, sizes: RunSizes) -> Self {
        let row = RowLayout::new(spec.observation.width(), spec.action.width());
        Self {
            learner,
            sampler: Sampler::new(seed),
            batch: Minibatch::new(row, batch),
            indices: vec![0; batch],
            capacity: sizes.capacity,
        }
    }
}

impl<L: MinibatchLearner> Algorithm for Replayed<L> {
    fn policy(&self) -> &[f32] {
        self.learner.policy()
    }

    fn layout(&self) -> PolicyLayout {
        self.learner.layout()
    }

    fn updates(&self) -> u64 {
        self.learner.updates()
    }

    fn update(&mut self, replay: &Replay, rows: u64) -> Losses {
        let window = replay.window(rows, self.capacity);
        self.sampler
            .indices(self.learner.updates(), window.clone(), &mut self.indices);
        self.batch.gather(replay, &self.indices, &window);
        self.learner.learn(&self.batch)
    }

    fn set_threads(&mut self, threads: Threads) {
        self.learner.set_threads(threads);
    }

    fn state(&self) -> Vec<Section<'_>> {
        self.learner.state()
    }

    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), SectionError> {
        for (name, numbers) in self.learner.state_mut(updates) {
            numbers.copy_from_slice(&saved.take(name, numbers.len())?);
        }
        Ok(())
    }
}

/// y = r + discount · value of s', for each transition. The value of a terminal s' is not used, even if it is NaN.
pub(super) fn targets(batch: &Minibatch, value: impl Fn(usize) -> f32, y: &mut DVector<f32>) {
    for (i, y) in y.iter_mut().enumerate() {
        let discount = batch.discount[i];
        *y = batch.r[i] + if discount == 0.0 { 0.0 } else { discount * value(i) };
    }
}

/// The mean of the numbers, of which there must be at least one.
pub(super) fn mean(numbers: impl ExactSizeIterator<Item = f32>) -> f32 {
    let count = numbers.len() as f32;
    numbers.sum::<f32>() / count
}
