//! Learning from the replay: minibatches drawn at random from its newest rows (line 11 of Algorithm 4).

use std::borrow::Cow;

use nalgebra::DVector;
use shoal_common::config::Config;
use shoal_common::policy::{PolicyError, PolicyLayout};

use super::algorithm::{Algorithm, Losses, SavedState, StateArray, StateArrayError, StateArrayMut};
use super::minibatch::Minibatch;
use super::normaliser::Normaliser;
use super::sampling::Sampler;
use crate::networks::threads::Threads;
use crate::replay::Replay;

/// A learner that takes gradient steps with minibatches, wherever those come from.
pub trait MinibatchLearner {
    /// The policy's parameters, without those that normalise observations.
    fn policy(&self) -> &[f32];

    /// Gradient steps taken.
    fn updates(&self) -> u64;

    /// Shares the work of a gradient step among these threads from now on, if there is enough of it. The bits of the
    /// results do not depend on them.
    fn set_threads(&mut self, threads: Threads);

    /// Takes a gradient step. Nothing is allocated. Panics if the batch has other dimensions than the networks and
    /// settings.
    fn learn(&mut self, batch: &Minibatch) -> Losses;

    /// Everything that the next gradient step depends on besides the batch, by name.
    fn state(&self) -> Vec<StateArray<'_>>;

    /// The same numbers, to be overwritten with those of a learner after `updates` gradient steps.
    fn state_mut(&mut self, updates: u64) -> Vec<StateArrayMut<'_>>;
}

/// A learner with its sampling from the replay.
#[derive(Debug)]
pub struct MinibatchAlgorithm<L> {
    learner: L,
    sampler: Sampler,
    batch: Minibatch,
    indices: Vec<u64>,
    capacity: u64,
    layout: PolicyLayout,
    normaliser: Option<Normaliser>,
    reward_scale: f32,
}

impl<L: MinibatchLearner> MinibatchAlgorithm<L> {
    /// Samples minibatches for the `learner` of a run with this configuration.
    ///
    /// # Errors
    /// When the algorithm cannot control the environment.
    pub fn new(learner: L, config: &Config) -> Result<Self, PolicyError> {
        let (row, batch) = (config.row_layout(), config.algorithm.settings().batch());
        let normalise = config.observation.normalise;
        Ok(Self {
            learner,
            sampler: Sampler::new(config.run.seed),
            batch: Minibatch::new(row, batch),
            indices: vec![0; batch],
            capacity: config.replay.capacity,
            layout: config.policy_layout()?,
            normaliser: normalise.then(|| Normaliser::new(row.observation_width())),
            reward_scale: config.reward.scale as f32,
        })
    }
}

impl<L: MinibatchLearner> Algorithm for MinibatchAlgorithm<L> {
    fn policy(&self) -> Cow<'_, [f32]> {
        match &self.normaliser {
            None => self.learner.policy().into(),
            Some(normaliser) => [self.learner.policy(), normaliser.published()].concat().into(),
        }
    }

    fn layout(&self) -> PolicyLayout {
        self.layout
    }

    fn updates(&self) -> u64 {
        self.learner.updates()
    }

    fn update(&mut self, replay: &Replay, rows: u64) -> Losses {
        let range = replay.sampling_range(rows, self.capacity);
        self.sampler
            .indices(self.learner.updates(), range.clone(), &mut self.indices);
        self.batch.gather(replay, &self.indices, &range);
        if let Some(normaliser) = &mut self.normaliser {
            normaliser.count(replay, rows);
            normaliser.apply(&mut self.batch);
        }
        if self.reward_scale != 1.0 {
            self.batch.r *= self.reward_scale;
        }
        self.learner.learn(&self.batch)
    }

    fn set_threads(&mut self, threads: Threads) {
        self.learner.set_threads(threads);
    }

    fn state(&self) -> Vec<StateArray<'_>> {
        let mut arrays = self.learner.state();
        arrays.extend(self.normaliser.as_ref().map(Normaliser::state));
        arrays
    }

    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), StateArrayError> {
        let mut arrays = self.learner.state_mut(updates);
        arrays.extend(self.normaliser.as_mut().map(Normaliser::state_mut));
        for (name, numbers) in arrays {
            numbers.copy_from_slice(&saved.take(name, numbers.len())?);
        }
        if let Some(normaliser) = &mut self.normaliser {
            normaliser.restored();
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
