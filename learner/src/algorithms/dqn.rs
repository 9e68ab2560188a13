//! Deep Q-network: Mnih et al. 2015, with the double estimate of van Hasselt et al. 2016 and, as a setting, dueling
//! heads after Wang et al. 2016, but on hidden layers that they share.
//!
//! Symbols as there: action-values Q with parameters θ, target network Q' with θ⁻, target y.

use nalgebra::{DMatrix, DVector};
use shoal_common::config::{self, Config};
use shoal_common::policy::{self, PolicyError, argmax};
use shoal_common::space::EnvironmentSpec;

use super::algorithm::{Algorithm, AlgorithmDefinition, Losses, RunSizes, StateArray, StateArrayMut};
use super::minibatch::Minibatch;
use super::minibatch_algorithm::{MinibatchAlgorithm, SampledAlgorithm, targets};
use crate::networks::initialise::fan_in;
use crate::networks::pass::Pass;
use crate::networks::product::{self, Products};
use crate::networks::threads::Threads;
use crate::networks::trainable::{NetworkWithTarget, threads_for};

/// The names of the network's arrays in a checkpoint: parameters, target, moments.
const ARRAYS: [&str; 4] = [
    "action-values",
    "target action-values",
    "action-values' first moment",
    "action-values' second moment",
];

/// The state of DQN.
#[derive(Clone, Debug)]
pub struct Dqn {
    settings: config::DqnConfig,
    threads: Threads,
    updates: u64,
    network: NetworkWithTarget,
    // Buffers.
    q: Pass,
    next_q: Pass,
    target_q: Pass,
    /// The value of s'.
    next_value: DVector<f32>,
    y: DVector<f32>,
    d_q: DMatrix<f32>,
}

impl Dqn {
    /// A new network, drawn from `seed`. The settings come from a checked configuration.
    ///
    /// # Errors
    /// When the environment's actions are not discrete, or its observations are not real numbers.
    pub fn new(spec: &EnvironmentSpec, settings: &config::DqnConfig, seed: u64) -> Result<Self, PolicyError> {
        let batch = settings.batch;
        let layout = settings.network(spec);
        policy::action_values(layout, settings.dueling, spec, 0)?;
        Ok(Self {
            threads: Threads::SINGLE,
            updates: 0,
            network: NetworkWithTarget::new(layout, settings.learning_rate, &fan_in(&layout, seed, 0)),
            q: Pass::new(layout, batch),
            next_q: Pass::new(layout, batch),
            target_q: Pass::new(layout, batch),
            next_value: DVector::zeros(batch),
            y: DVector::zeros(batch),
            d_q: DMatrix::zeros(layout.outputs(), batch),
            settings: settings.clone(),
        })
    }

    /// Takes a gradient step. Returns the mean of Huber's loss of y − Q(s, a), and the mean of Q(s, a) before it.
    pub fn update(&mut self, batch: &Minibatch) -> Losses {
        let t = self.updates + 1;
        self.evaluate(batch);
        let (loss, q_mean) = self.gradient(batch);
        self.network.online.step(&self.threads, t);
        if t.is_multiple_of(self.settings.target_every) {
            self.network.copy_to_target();
        }
        self.updates = t;
        Losses {
            critic_loss: loss,
            q_mean,
            ..Losses::default()
        }
    }

    /// Evaluates Q(s, ·), Q(s', ·) and Q'(s', ·). Then y = r + discount · Q'(s', a'), where a' is the best action by Q
    /// (double) or by Q'.
    fn evaluate(&mut self, batch: &Minibatch) {
        let Self {
            settings,
            threads,
            network,
            q,
            next_q,
            target_q,
            next_value,
            y,
            ..
        } = self;
        let (theta, s_next) = (&network.online.parameters, batch.s_next.as_slice());
        threads.both(
            || q.forward(theta, batch.s.as_slice(), &[]),
            || {
                if settings.double {
                    next_q.forward(theta, s_next, &[]);
                }
                target_q.forward(&network.target, s_next, &[]);
            },
        );
        if settings.dueling {
            for pass in [q, &mut *next_q, &mut *target_q] {
                pass.output
                    .column_iter_mut()
                    .for_each(|mut heads| policy::combine_heads(heads.as_mut_slice()));
            }
        }
        let first = usize::from(settings.dueling);
        let chooser = if settings.double { &*next_q } else { &*target_q };
        let samples = chooser.output.column_iter().zip(target_q.output.column_iter());
        for (value, (chooser, target)) in next_value.iter_mut().zip(samples) {
            *value = target[first + argmax(&chooser.as_slice()[first..])];
        }
        targets(batch, |i| next_value[i], y);
    }

    /// The gradient of the mean of Huber's loss of e = Q(s, a) − y: e clipped to −δ … δ. Returns the loss and the mean
    /// of Q(s, a).
    fn gradient(&mut self, batch: &Minibatch) -> (f32, f32) {
        let delta = self.settings.huber_delta as f32;
        let share = 1.0 / batch.size() as f32;
        let first = usize::from(self.settings.dueling);
        let (mut loss, mut q_mean) = (0.0, 0.0);
        self.d_q.fill(0.0);
        let samples = self.d_q.column_iter_mut().zip(self.q.output.column_iter());
        for (i, (mut d, q)) in samples.enumerate() {
            let action = (batch.a[i] as usize).min(q.len() - 1 - first);
            let q = q[first + action];
            let e = q - self.y[i];
            let clipped = e.clamp(-delta, delta);
            // ½ e², or δ (|e| − ½ δ) beyond δ.
            loss += share * clipped.abs() * (e.abs() - 0.5 * clipped.abs());
            q_mean += share * q;
            d[first + action] = share * clipped;
            if self.settings.dueling {
                split_into_heads(d.as_mut_slice());
            }
        }
        let online = &mut self.network.online;
        let s = batch.s.as_slice();
        self.q
            .backward(&self.threads, &online.parameters, s, &self.d_q, &mut online.gradient);
        (loss, q_mean)
    }
}

/// Backward pass of `combine_heads`: `d` holds ∂L/∂Q from its second number on, and afterwards ∂L/∂(V, A).
fn split_into_heads(d: &mut [f32]) {
    if let [d_value, d_advantages @ ..] = d {
        *d_value = d_advantages.iter().sum();
        let mean = *d_value / d_advantages.len() as f32;
        d_advantages.iter_mut().for_each(|d| *d -= mean);
    }
}

impl MinibatchAlgorithm for Dqn {
    fn policy(&self) -> &[f32] {
        &self.network.online.parameters
    }

    fn updates(&self) -> u64 {
        self.updates
    }

    fn set_threads(&mut self, threads: Threads) {
        self.threads = threads_for(&self.network.online.layout, self.settings.batch, threads);
    }

    fn gradient_step(&mut self, batch: &Minibatch) -> Losses {
        self.update(batch)
    }

    fn state(&self) -> Vec<StateArray<'_>> {
        let NetworkWithTarget { online, target } = &self.network;
        let (m, v) = (&online.adam.first_moment, &online.adam.second_moment);
        let arrays: [&[f32]; 4] = [&online.parameters, target, m, v];
        ARRAYS.into_iter().zip(arrays).collect()
    }

    fn state_mut(&mut self, updates: u64) -> Vec<StateArrayMut<'_>> {
        self.updates = updates;
        let NetworkWithTarget { online, target } = &mut self.network;
        let (m, v) = (&mut online.adam.first_moment, &mut online.adam.second_moment);
        let arrays: [&mut [f32]; 4] = [&mut online.parameters, target, m, v];
        ARRAYS.into_iter().zip(arrays).collect()
    }
}

impl AlgorithmDefinition for &config::DqnConfig {
    fn create(&self, config: &Config) -> Result<Box<dyn Algorithm>, PolicyError> {
        let dqn = Dqn::new(&config.spec, self, config.run.seed)?;
        Ok(Box::new(SampledAlgorithm::new(dqn, config)?))
    }

    fn weight_names(&self) -> &'static [&'static str] {
        &ARRAYS[..2]
    }

    fn products(&self, spec: &EnvironmentSpec) -> Products {
        let q = &self.network(spec);
        let forward_passes = if self.double { 3 } else { 2 };
        let forward = (0..forward_passes).flat_map(|_| product::forward(q, self.batch));
        Products {
            updates: 1,
            products: forward.chain(product::backward(q, self.batch)).collect(),
        }
    }

    fn state_numbers(&self, spec: &EnvironmentSpec, _: RunSizes) -> usize {
        // The network with its target and two moments.
        4 * self.network(spec).parameters()
    }
}

#[cfg(test)]
mod tests;
