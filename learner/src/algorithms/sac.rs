//! Soft actor-critic with a learned temperature: Haarnoja et al. 2018b, algorithm 1. As in common implementations, ln α
//! is learned instead of α and updated first; the losses use α from before that step.
//!
//! Symbols as there: policy π with parameters φ, critics Q₁ and Q₂ and their targets with a prime, temperature α,
//! target entropy H̄. An action is a = tanh u, u = μ + σ ε, with ε standard normal. Actions within an update are scaled
//! to [−1, 1], as is the density π(a|s).

use std::f32::consts::{LN_2, PI};

use nalgebra::{DMatrix, DVector};
use rand::RngExt;
use rand_distr::StandardNormal;
use shoal_common::algorithms::ActorCritic;
use shoal_common::config::{self, Config};
use shoal_common::network::{ActionRange, LOG_STD_RANGE, NetworkLayout};
use shoal_common::policy::PolicyError;
use shoal_common::space::EnvironmentSpec;
use shoal_common::stream::{Purpose, Stream, seek, stream};

use super::algorithm::{Algorithm, AlgorithmDefinition, Losses, RunSizes, StateArray, StateArrayMut};
use super::minibatch::Minibatch;
use super::minibatch_algorithm::{MinibatchAlgorithm, SampledAlgorithm, mean};
use super::twin_critics::{self, CriticLosses, CriticPart, TwinCritics};
use crate::networks::adam::Adam;
use crate::networks::initialise::fan_in;
use crate::networks::pass::{Pass, Samples};
use crate::networks::product::{self, Products};
use crate::networks::threads::Threads;
use crate::networks::trainable::{TrainableNetwork, threads_for};

/// The names of the actor's arrays in a checkpoint: parameters, moments.
const ACTOR: [&str; 3] = ["actor", "actor's first moment", "actor's second moment"];

/// The names of the temperature's arrays: ln α, moments.
const TEMPERATURE: [&str; 3] = [
    "log temperature",
    "log temperature's first moment",
    "log temperature's second moment",
];

/// What is learned, as opposed to the state of the optimisers.
const WEIGHTS: [&str; 6] = [
    "actor",
    "critic 1",
    "target critic 1",
    "critic 2",
    "target critic 2",
    "log temperature",
];

/// Actions drawn from π(·|s) for the observations of a minibatch.
#[derive(Clone, Debug)]
struct Draw {
    /// The policy's pass. Its outputs are all means μ of a sample, then all ln σ.
    pi: Pass,
    /// ε, standard normal.
    noise: DMatrix<f32>,
    /// a.
    a: DMatrix<f32>,
    /// ln π(a|s).
    log_pi: DVector<f32>,
}

impl Draw {
    fn new(layout: NetworkLayout, action: usize, batch: usize) -> Self {
        Self {
            pi: Pass::new(layout, batch),
            noise: DMatrix::zeros(action, batch),
            a: DMatrix::zeros(action, batch),
            log_pi: DVector::zeros(batch),
        }
    }

    /// The first `cut` samples, and the others.
    fn split_at(&mut self, cut: usize) -> (DrawPart<'_>, DrawPart<'_>) {
        let width = self.a.nrows();
        let pi = self.pi.samples().split_at(cut);
        let noise = self.noise.as_slice().split_at(cut * width);
        let a = self.a.as_mut_slice().split_at_mut(cut * width);
        let log_pi = self.log_pi.as_mut_slice().split_at_mut(cut);
        let part = |pi, noise, a, log_pi| DrawPart {
            width,
            pi,
            noise,
            a,
            log_pi,
        };
        (part(pi.0, noise.0, a.0, log_pi.0), part(pi.1, noise.1, a.1, log_pi.1))
    }
}

/// Some samples of a [`Draw`].
struct DrawPart<'a> {
    width: usize,
    pi: Samples<'a>,
    noise: &'a [f32],
    a: &'a mut [f32],
    log_pi: &'a mut [f32],
}

impl DrawPart<'_> {
    /// Draws a for each observation of `s` with the policy φ.
    fn draw(&mut self, phi: &[f32], s: &[f32]) {
        let width = self.width;
        self.pi.forward(phi, s, &[]);
        let outputs = self.pi.output.chunks_exact(2 * width);
        let samples = self.a.chunks_exact_mut(width).zip(self.noise.chunks_exact(width));
        for ((outputs, (a, noise)), log_pi) in outputs.zip(samples).zip(&mut *self.log_pi) {
            let (mu, log_sigma) = outputs.split_at(width);
            *log_pi = 0.0;
            for (i, (a, epsilon)) in a.iter_mut().zip(noise).enumerate() {
                let log_sigma = log_sigma[i].clamp(LOG_STD_RANGE.0, LOG_STD_RANGE.1);
                let u = mu[i] + log_sigma.exp() * epsilon;
                *a = u.tanh();
                *log_pi += log_density(u, *epsilon, log_sigma);
            }
        }
    }

    /// Computes ∂L/∂(μ, ln σ) of the draw from both critics' ∂L/∂a and from `share`, the weight of each sample's ln π
    /// in L. With ε fixed, ∂ ln π/∂u = 2 tanh u, ∂u/∂μ = 1 and ∂u/∂ln σ = σ ε.
    fn backward(&self, share: f32, d_a: [&[f32]; 2], d_pi: &mut [f32]) {
        let width = self.width;
        let of_sample = self
            .pi
            .output
            .chunks_exact(2 * width)
            .zip(d_pi.chunks_exact_mut(2 * width));
        for (sample, (outputs, d_pi)) in of_sample.enumerate() {
            let log_sigma = &outputs[width..];
            let (d_mu, d_log_sigma) = d_pi.split_at_mut(width);
            for i in 0..width {
                let at = sample * width + i;
                let a = self.a[at];
                let d_u = 2.0 * share * a + (d_a[0][at] + d_a[1][at]) * (1.0 - a * a);
                d_mu[i] = d_u;
                // Where ln σ is clamped, it has no effect.
                let is_free = (LOG_STD_RANGE.0..=LOG_STD_RANGE.1).contains(&log_sigma[i]);
                d_log_sigma[i] = if is_free {
                    d_u * log_sigma[i].exp() * self.noise[at] - share
                } else {
                    0.0
                };
            }
        }
    }
}

/// ln of the density of a = tanh u, where u = μ + σ ε: ln N(u; μ, σ²) − ln(1 − tanh² u). The last term is written as
/// 2 (ln 2 − u − softplus(−2u)), which is exact for any u.
fn log_density(u: f32, epsilon: f32, log_sigma: f32) -> f32 {
    let normal = -0.5 * epsilon * epsilon - log_sigma - 0.5 * (2.0 * PI).ln();
    normal - 2.0 * (LN_2 - u - softplus(-2.0 * u))
}

/// ln(1 + eˣ).
fn softplus(x: f32) -> f32 {
    x.max(0.0) + (-x.abs()).exp().ln_1p()
}

/// α with its optimiser, as ln α.
#[derive(Clone, Debug)]
struct Temperature {
    /// H̄.
    target_entropy: f32,
    log_alpha: [f32; 1],
    adam: Adam,
}

impl Temperature {
    fn alpha(&self) -> f32 {
        self.log_alpha[0].exp()
    }

    /// Takes step number `t` against the gradient of −1/N Σ ln α · (ln π(a|s) + H̄).
    fn step(&mut self, t: u64, log_pi: &DVector<f32>) {
        let gradient = [-mean(log_pi.iter().map(|log_pi| log_pi + self.target_entropy))];
        self.adam.step(&Threads::SINGLE, t, &gradient, &mut self.log_alpha);
    }
}

/// The state of SAC.
#[derive(Clone, Debug)]
pub struct Sac {
    range: ActionRange,
    tau: f32,
    threads: Threads,
    updates: u64,
    actor: TrainableNetwork,
    critics: TwinCritics,
    temperature: Temperature,
    /// Part `u` of this stream has the noise of update number `u`.
    stream: Stream,
    // Buffers.
    now: Draw,
    next: Draw,
    /// −α ln π(a'|s').
    bonus: DVector<f32>,
    /// ∂L/∂(μ, ln σ).
    d_pi: DMatrix<f32>,
}

impl Sac {
    /// New networks, drawn from `seed`. The settings come from a checked configuration.
    ///
    /// # Errors
    /// When the environment's actions are not real numbers in finite ranges.
    pub fn new(spec: &EnvironmentSpec, settings: &config::SacConfig, seed: u64) -> Result<Self, PolicyError> {
        let range = ActionRange::new(&spec.action)?;
        let ActorCritic { actor: pi, critic: q } = settings.networks(spec);
        let (action, batch) = (range.width(), settings.batch);
        Ok(Self {
            range,
            tau: settings.tau as f32,
            threads: Threads::SINGLE,
            updates: 0,
            actor: TrainableNetwork::new(pi, settings.actor_learning_rate, &fan_in(&pi, seed, 0)),
            critics: TwinCritics::new(q, settings.critic_learning_rate, batch, seed),
            temperature: Temperature {
                target_entropy: settings.target_entropy_per_element as f32 * action as f32,
                log_alpha: [settings.initial_temperature.ln() as f32],
                adam: Adam::new(settings.temperature_learning_rate, 1),
            },
            stream: stream(seed, Purpose::Update, 0, 0),
            now: Draw::new(pi, action, batch),
            next: Draw::new(pi, action, batch),
            bonus: DVector::zeros(batch),
            d_pi: DMatrix::zeros(2 * action, batch),
        })
    }

    /// α.
    pub fn temperature(&self) -> f32 {
        self.temperature.alpha()
    }

    /// Makes one update with this standard normal noise ε for the actions in s and in s', a column for each sample.
    /// Returns the sum of the critics' losses, the actor's loss, the mean of Q₁(s, a) before its step, and α.
    pub fn update(&mut self, batch: &Minibatch, noise: &DMatrix<f32>, next_noise: &DMatrix<f32>) -> Losses {
        self.now.noise.copy_from(noise);
        self.next.noise.copy_from(next_noise);
        self.update_with_drawn_noise(batch)
    }

    fn update_with_drawn_noise(&mut self, batch: &Minibatch) -> Losses {
        let t = self.updates + 1;
        self.draw(batch);
        // Both losses below have α from before its step.
        let alpha = self.temperature.alpha();
        self.temperature.step(t, &self.now.log_pi);
        for (bonus, log_pi) in self.bonus.iter_mut().zip(&self.next.log_pi) {
            *bonus = -alpha * log_pi;
        }
        let CriticLosses { loss, q_mean } = self.critics.step(
            &self.threads,
            t,
            Some(self.tau),
            batch,
            &self.range,
            (&self.next.a, &self.bonus),
        );
        let actor_loss = self.actor_gradient(&batch.s, alpha);
        self.actor.step(&self.threads, t);
        self.updates = t;
        Losses {
            critic_loss: loss,
            actor_loss,
            q_mean,
            temperature: Some(alpha),
        }
    }

    /// Draws actions in s and in s'. The threads share the samples.
    fn draw(&mut self, batch: &Minibatch) {
        let phi = &self.actor.parameters;
        let cut = self.threads.first_share(batch.size());
        let observations = |matrix: &DMatrix<f32>| cut * matrix.nrows();
        let s = batch.s.as_slice().split_at(observations(&batch.s));
        let s_next = batch.s_next.as_slice().split_at(observations(&batch.s_next));
        let (mut now, mut next) = (self.now.split_at(cut), self.next.split_at(cut));
        self.threads.both(
            || {
                now.0.draw(phi, s.0);
                next.0.draw(phi, s_next.0);
            },
            || {
                now.1.draw(phi, s.1);
                next.1.draw(phi, s_next.1);
            },
        );
    }

    /// The gradient of the loss 1/N Σ (α ln π(a|s) − min Q(s, a)), with the critics after their step. Returns the loss.
    /// Up to the gradients of φ the samples are independent, and the threads share them.
    fn actor_gradient(&mut self, s: &DMatrix<f32>, alpha: f32) -> f32 {
        let size = s.ncols();
        let actor = &mut self.actor;
        let phi = &*actor.parameters;
        let cut = self.threads.first_share(size);
        let part =
            |mut draw: DrawPart<'_>, [mut first, mut second]: [CriticPart<'_>; 2], s: &[f32], d_pi: &mut [f32]| {
                first.forward(s, draw.a);
                second.forward(s, draw.a);
                for i in 0..draw.log_pi.len() {
                    let first_is_less = first.values()[i] <= second.values()[i];
                    let each = -1.0 / size as f32;
                    (first.d_q[i], second.d_q[i]) = if first_is_less { (each, 0.0) } else { (0.0, each) };
                }
                first.backward();
                second.backward();
                draw.backward(alpha / size as f32, [first.d_a, second.d_a], d_pi);
                draw.pi.backward(phi, d_pi, 1);
            };
        let observations = s.as_slice().split_at(cut * s.nrows());
        let outputs = self.d_pi.nrows();
        let d_pi = self.d_pi.as_mut_slice().split_at_mut(cut * outputs);
        let draw = self.now.split_at(cut);
        let [first, second] = &mut self.critics.critics;
        let (q1, q2) = (first.split_at(cut), second.split_at(cut));
        self.threads.both(
            || part(draw.0, [q1.0, q2.0], observations.0, d_pi.0),
            || part(draw.1, [q1.1, q2.1], observations.1, d_pi.1),
        );
        self.now
            .pi
            .gradients(&self.threads, phi, s.as_slice(), &self.d_pi, &mut actor.gradient);
        let values = first.q.output.iter().zip(second.q.output.iter());
        let losses = values
            .zip(&self.now.log_pi)
            .map(|((q1, q2), log_pi)| alpha * log_pi - q1.min(*q2));
        mean(losses)
    }
}

impl MinibatchAlgorithm for Sac {
    fn policy(&self) -> &[f32] {
        &self.actor.parameters
    }

    fn updates(&self) -> u64 {
        self.updates
    }

    fn set_threads(&mut self, threads: Threads) {
        self.threads = threads_for(self.critics.layout(), self.bonus.len(), threads);
    }

    fn gradient_step(&mut self, batch: &Minibatch) -> Losses {
        let stream = seek(&mut self.stream, self.updates);
        for noise in [&mut self.now.noise, &mut self.next.noise] {
            noise
                .iter_mut()
                .for_each(|normal| *normal = stream.sample(StandardNormal));
        }
        self.update_with_drawn_noise(batch)
    }

    fn state(&self) -> Vec<StateArray<'_>> {
        let TrainableNetwork { parameters, adam, .. } = &self.actor;
        let actor: [&[f32]; 3] = [parameters, &adam.first_moment, &adam.second_moment];
        let Temperature { log_alpha, adam, .. } = &self.temperature;
        let temperature: [&[f32]; 3] = [log_alpha, &adam.first_moment, &adam.second_moment];
        let arrays = actor.into_iter().chain(self.critics.arrays().into_iter().flatten());
        array_names().zip(arrays.chain(temperature)).collect()
    }

    fn state_mut(&mut self, updates: u64) -> Vec<StateArrayMut<'_>> {
        self.updates = updates;
        let TrainableNetwork { parameters, adam, .. } = &mut self.actor;
        let actor: [&mut [f32]; 3] = [parameters, &mut adam.first_moment, &mut adam.second_moment];
        let Temperature { log_alpha, adam, .. } = &mut self.temperature;
        let temperature: [&mut [f32]; 3] = [log_alpha, &mut adam.first_moment, &mut adam.second_moment];
        let arrays = actor.into_iter().chain(self.critics.arrays_mut().into_iter().flatten());
        array_names().zip(arrays.chain(temperature)).collect()
    }
}

/// The names of all arrays of the state.
fn array_names() -> impl Iterator<Item = &'static str> {
    let critics = twin_critics::ARRAYS.into_iter().flatten();
    ACTOR.into_iter().chain(critics).chain(TEMPERATURE)
}

impl AlgorithmDefinition for &config::SacConfig {
    fn create(&self, config: &Config) -> Result<Box<dyn Algorithm>, PolicyError> {
        let sac = Sac::new(&config.spec, self, config.run.seed)?;
        Ok(Box::new(SampledAlgorithm::new(sac, config)?))
    }

    fn weight_names(&self) -> &'static [&'static str] {
        &WEIGHTS
    }

    fn products(&self, spec: &EnvironmentSpec) -> Products {
        let ActorCritic { actor: pi, critic: q } = &self.networks(spec);
        let batch = self.batch;
        let improve = || product::forward(q, batch).chain(product::backward_to_actions(q, batch));
        let products = (product::forward(pi, batch).chain(product::forward(pi, batch)))
            .chain(twin_critics::products(q, batch))
            .chain(improve())
            .chain(improve())
            .chain(product::backward(pi, batch));
        Products {
            updates: 1,
            products: products.collect(),
        }
    }

    fn state_numbers(&self, spec: &EnvironmentSpec, _: RunSizes) -> usize {
        let ActorCritic { actor, critic } = self.networks(spec);
        // The actor with two moments, each critic with a target and two moments, ln α with two moments.
        3 * actor.parameters() + 2 * 4 * critic.parameters() + 3
    }
}

#[cfg(test)]
mod tests;
