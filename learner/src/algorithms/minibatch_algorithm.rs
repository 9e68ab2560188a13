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

/// An algorithm that takes gradient steps with minibatches from any source.
pub trait MinibatchAlgorithm {
    /// The policy's parameters, without the statistics of observations.
    fn policy(&self) -> &[f32];

    /// Gradient steps taken.
    fn updates(&self) -> u64;

    /// Shares the work of a gradient step among these threads from now on, if there is enough of it. The bits of the
    /// results do not depend on them.
    fn set_threads(&mut self, threads: Threads);

    /// Takes a gradient step. Nothing is allocated. Panics if the batch has other dimensions than the networks and
    /// settings.
    fn gradient_step(&mut self, batch: &Minibatch) -> Losses;

    /// Everything that the next gradient step depends on besides the batch, by name.
    fn state(&self) -> Vec<StateArray<'_>>;

    /// The arrays of `state`, to be overwritten with the state after `updates` gradient steps. Sets the number of
    /// steps.
    fn state_mut(&mut self, updates: u64) -> Vec<StateArrayMut<'_>>;
}

/// An algorithm with its sampling from the replay.
#[derive(Debug)]
pub struct SampledAlgorithm<A> {
    algorithm: A,
    sampler: Sampler,
    batch: Minibatch,
    indices: Vec<u64>,
    capacity: u64,
    layout: PolicyLayout,
    normaliser: Option<Normaliser>,
    reward_scale: f32,
}

impl<A: MinibatchAlgorithm> SampledAlgorithm<A> {
    /// Samples minibatches for the `algorithm` of a run with this configuration.
    ///
    /// # Errors
    /// When the algorithm cannot control the environment.
    pub fn new(algorithm: A, config: &Config) -> Result<Self, PolicyError> {
        let (row, batch) = (config.row_layout(), config.algorithm.settings().batch());
        let normalise = config.observation.normalise;
        Ok(Self {
            algorithm,
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

impl<A: MinibatchAlgorithm> Algorithm for SampledAlgorithm<A> {
    fn policy(&self) -> Cow<'_, [f32]> {
        match &self.normaliser {
            None => self.algorithm.policy().into(),
            Some(normaliser) => [self.algorithm.policy(), normaliser.published()].concat().into(),
        }
    }

    fn layout(&self) -> PolicyLayout {
        self.layout
    }

    fn updates(&self) -> u64 {
        self.algorithm.updates()
    }

    fn update(&mut self, replay: &Replay, rows: u64) -> Option<Losses> {
        let range = replay.sampling_range(rows, self.capacity);
        self.sampler
            .indices(self.algorithm.updates(), range.clone(), &mut self.indices);
        self.batch.gather(replay, &self.indices, &range);
        if let Some(normaliser) = &mut self.normaliser {
            normaliser.count(replay, rows);
            normaliser.apply(&mut self.batch);
        }
        if self.reward_scale != 1.0 {
            self.batch.r *= self.reward_scale;
        }
        Some(self.algorithm.gradient_step(&self.batch))
    }

    fn set_threads(&mut self, threads: Threads) {
        self.algorithm.set_threads(threads);
    }

    fn state(&self) -> Vec<StateArray<'_>> {
        let mut arrays = self.algorithm.state();
        arrays.extend(self.normaliser.as_ref().map(Normaliser::state));
        arrays
    }

    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), StateArrayError> {
        let mut arrays = self.algorithm.state_mut(updates);
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

/// The mean of at least one number.
pub(super) fn mean(numbers: impl ExactSizeIterator<Item = f32>) -> f32 {
    let count = numbers.len() as f32;
    numbers.sum::<f32>() / count
}
