//! A network with its gradient and its optimiser, and a network with the target network that follows it.

use shoal_common::network::NetworkLayout;

use super::adam::Adam;
use super::aligned::Aligned;
use super::threads::Threads;

/// Two threads are used only if there are at least this many samples, and this many units in each hidden layer except
/// the last of several. If a dimension is 1 or the product is small, faer adds the terms of a transposed product in
/// another order, and the bits must not depend on the number of threads.
const MIN_SPLIT: usize = 4;
/// As [`MIN_SPLIT`], for samples times units of each hidden layer but the first (or of the only one).
const MIN_WORK: usize = 8_192;

/// `threads`, if sharing the work for `batch` samples of this network leaves the bits of the result unchanged;
/// otherwise the calling thread alone.
pub fn threads_for(layout: &NetworkLayout, batch: usize, threads: Threads) -> Threads {
    let layers = layout.hidden().layers;
    let others = layers.len() - 1;
    let (all_but_last, all_but_first) = (&layers[..others.max(1)], &layers[others.min(1)..]);
    let enough = batch >= MIN_SPLIT
        && all_but_last.iter().all(|units| *units >= MIN_SPLIT)
        && all_but_first.iter().all(|units| units * batch >= MIN_WORK);
    if enough { threads } else { Threads::SINGLE }
}

/// A network that learns.
#[derive(Clone, Debug)]
pub struct TrainableNetwork {
    /// The layout of the parameters.
    pub layout: NetworkLayout,
    /// θ.
    pub parameters: Aligned,
    /// ∂L/∂θ.
    pub gradient: Aligned,
    /// The optimiser.
    pub adam: Adam,
}

impl TrainableNetwork {
    /// A network with these parameters, before its first step.
    pub fn new(layout: NetworkLayout, learning_rate: f64, parameters: &[f32]) -> Self {
        Self {
            layout,
            parameters: Aligned::from_slice(parameters, 0),
            gradient: Aligned::zeros(parameters.len(), 2),
            adam: Adam::new(learning_rate, parameters.len()),
        }
    }

    /// Takes step number `t` (from 1) of Adam against the gradient.
    pub fn step(&mut self, threads: &Threads, t: u64) {
        self.adam.step(threads, t, &self.gradient, &mut self.parameters);
    }
}

/// A network that learns, and its target network.
#[derive(Clone, Debug)]
pub struct NetworkWithTarget {
    /// The network, θ.
    pub online: TrainableNetwork,
    /// The target network's parameters, θ'.
    pub target: Aligned,
}

impl NetworkWithTarget {
    /// A network with these parameters, before its first step; θ' ← θ.
    pub fn new(layout: NetworkLayout, learning_rate: f64, parameters: &[f32]) -> Self {
        Self {
            online: TrainableNetwork::new(layout, learning_rate, parameters),
            target: Aligned::from_slice(parameters, 1),
        }
    }

    /// Takes step number `t` (from 1) of Adam against the gradient; then θ' ← τ θ + (1 − τ) θ'.
    pub fn step_with_target(&mut self, threads: &Threads, t: u64, tau: f32) {
        let TrainableNetwork {
            parameters,
            gradient,
            adam,
            ..
        } = &mut self.online;
        adam.step_with_target(threads, t, gradient, parameters, tau, &mut self.target);
    }

    /// θ' ← θ.
    pub fn copy_to_target(&mut self) {
        self.target.copy_from_slice(&self.online.parameters);
    }
}
