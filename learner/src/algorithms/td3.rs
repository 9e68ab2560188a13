//! Twin delayed deep deterministic policy gradient: algorithm 1 of Fujimoto et al. 2018.
//!
//! Symbols as there: policy π with parameters φ, critics Q₁ and Q₂, their targets with a prime, standard normal noise
//! ε, whose product with σ̃ is clipped to [−c, c], delay d. Actions within an update are scaled to [−1, 1].

use nalgebra::{DMatrix, DVector};
use rand::RngExt;
use rand_distr::StandardNormal;
use shoal_common::algorithms::{ActorCritic, AlgorithmSettings};
use shoal_common::config::{self, Config};
use shoal_common::network::ActionRange;
use shoal_common::policy::PolicyError;
use shoal_common::space::EnvironmentSpec;
use shoal_common::stream::{Purpose, Stream, seek, stream};

use super::algorithm::{Algorithm, AlgorithmDefinition, Losses, RunSizes, StateArray, StateArrayMut};
use super::minibatch::Minibatch;
use super::minibatch_algorithm::{MinibatchAlgorithm, SampledAlgorithm, mean};
use super::twin_critics::{self, CriticLosses, CriticPart, TwinCritics};
use crate::networks::initialise::fan_in;
use crate::networks::pass::{Pass, Samples};
use crate::networks::product::{self, Products};
use crate::networks::threads::Threads;
use crate::networks::trainable::{NetworkWithTarget, threads_for};

/// The names of the actor's arrays in a checkpoint: parameters, target, moments.
const ACTOR: [&str; 4] = ["actor", "target actor", "actor's first moment", "actor's second moment"];

/// What is learned, as opposed to the state of the optimisers.
const WEIGHTS: [&str; 6] = [
    "actor",
    "target actor",
    "critic 1",
    "target critic 1",
    "critic 2",
    "target critic 2",
];

/// The state of TD3.
#[derive(Clone, Debug)]
pub struct Td3 {
    settings: config::Td3Config,
    range: ActionRange,
    threads: Threads,
    updates: u64,
    actor: NetworkWithTarget,
    critics: TwinCritics,
    /// Part `u` of this stream has the noise of update number `u`.
    stream: Stream,
    /// The loss of the newest step of the actor, for the reports.
    actor_loss: f32,
    // Buffers.
    mu: Pass,
    target_mu: Pass,
    /// Standard normal numbers, one for each element of a target action.
    noise: DMatrix<f32>,
    a_next: DMatrix<f32>,
    no_bonus: DVector<f32>,
    d_mu: DMatrix<f32>,
}

impl Td3 {
    /// New networks, drawn from `seed`. The settings come from a checked configuration.
    ///
    /// # Errors
    /// When the environment's actions are not real numbers in finite ranges.
    pub fn new(spec: &EnvironmentSpec, settings: &config::Td3Config, seed: u64) -> Result<Self, PolicyError> {
        let range = ActionRange::new(&spec.action)?;
        let ActorCritic { actor: mu, critic: q } = settings.networks(spec);
        let (action, batch) = (range.width(), settings.batch);
        Ok(Self {
            threads: Threads::SINGLE,
            updates: 0,
            actor: NetworkWithTarget::new(mu, settings.actor_learning_rate, &fan_in(&mu, seed, 0)),
            critics: TwinCritics::new(q, settings.critic_learning_rate, batch, seed),
            stream: stream(seed, Purpose::Update, 0, 0),
            actor_loss: 0.0,
            mu: Pass::new(mu, batch),
            target_mu: Pass::new(mu, batch),
            noise: DMatrix::zeros(action, batch),
            a_next: DMatrix::zeros(action, batch),
            no_bonus: DVector::zeros(batch),
            d_mu: DMatrix::zeros(action, batch),
            settings: settings.clone(),
            range,
        })
    }

    /// Makes one update with this standard normal noise, a column for each sample. Returns the sum of the
    /// critics' losses, the loss of the actor's newest step, and the mean of Q₁(s, a) before its step.
    pub fn update(&mut self, batch: &Minibatch, noise: &DMatrix<f32>) -> Losses {
        let t = self.updates + 1;
        let delayed = t.is_multiple_of(self.settings.policy_delay);
        let tau = self.settings.tau as f32;
        self.choose_next_actions(batch, noise);
        let CriticLosses { loss, q_mean } = self.critics.step(
            &self.threads,
            t,
            // The targets are not read again in this update.
            delayed.then_some(tau),
            batch,
            &self.range,
            (&self.a_next, &self.no_bonus),
        );
        if delayed {
            self.actor_loss = self.actor_gradient(&batch.s);
            let step = t / self.settings.policy_delay;
            self.actor.step_with_target(&self.threads, step, tau);
        }
        self.updates = t;
        Losses {
            critic_loss: loss,
            actor_loss: self.actor_loss,
            q_mean,
            ..Losses::default()
        }
    }

    /// a' = clip(π'(s') + clip(σ̃ ε, −c, c), −1, 1). The threads share the samples.
    fn choose_next_actions(&mut self, batch: &Minibatch, noise: &DMatrix<f32>) {
        let (sigma, clip) = (
            self.settings.target_noise as f32,
            self.settings.target_noise_clip as f32,
        );
        let (width, target) = (self.range.width(), &self.actor.target);
        let cut = self.threads.first_share(batch.size());
        let part = |mut mu: Samples<'_>, s: &[f32], noise: &[f32], a: &mut [f32]| {
            mu.forward(target, s, &[]);
            for ((a, z), normal) in a.iter_mut().zip(&*mu.output).zip(noise) {
                let epsilon = (sigma * normal).clamp(-clip, clip);
                *a = (z.tanh() + epsilon).clamp(-1.0, 1.0);
            }
        };
        let s = batch.s_next.as_slice().split_at(cut * batch.s_next.nrows());
        let noise = noise.as_slice().split_at(cut * width);
        let a = self.a_next.as_mut_slice().split_at_mut(cut * width);
        let mu = self.target_mu.samples().split_at(cut);
        self.threads
            .both(|| part(mu.0, s.0, noise.0, a.0), || part(mu.1, s.1, noise.1, a.1));
    }

    /// The gradient of the loss −1/N Σ Q₁(s, π(s)), with Q₁ after its step. Returns the loss. Up to the gradients of φ
    /// the samples are independent, and the threads share them.
    fn actor_gradient(&mut self, s: &DMatrix<f32>) -> f32 {
        let (width, size) = (self.range.width(), s.ncols());
        let actor = &mut self.actor.online;
        let phi = &*actor.parameters;
        let cut = self.threads.first_share(size);
        let part = |mut mu: Samples<'_>, mut critic: CriticPart<'_>, s: &[f32], d_mu: &mut [f32]| {
            mu.forward(phi, s, &[]);
            mu.output.iter_mut().for_each(|z| *z = z.tanh());
            critic.forward(s, mu.output);
            critic.d_q.fill(-1.0 / size as f32);
            critic.backward();
            for ((d, d_a), a) in d_mu.iter_mut().zip(&*critic.d_a).zip(&*mu.output) {
                *d = d_a * (1.0 - a * a);
            }
            mu.backward(phi, d_mu, 1);
        };
        let observations = s.as_slice().split_at(cut * s.nrows());
        let d_mu = self.d_mu.as_mut_slice().split_at_mut(cut * width);
        let first = &mut self.critics.critics[0];
        let (mu, critic) = (self.mu.samples().split_at(cut), first.split_at(cut));
        self.threads.both(
            || part(mu.0, critic.0, observations.0, d_mu.0),
            || part(mu.1, critic.1, observations.1, d_mu.1),
        );
        self.mu
            .gradients(&self.threads, phi, s.as_slice(), &self.d_mu, &mut actor.gradient);
        -mean(first.q.output.iter().copied())
    }
}

impl MinibatchAlgorithm for Td3 {
    fn policy(&self) -> &[f32] {
        &self.actor.online.parameters
    }

    fn updates(&self) -> u64 {
        self.updates
    }

    fn set_threads(&mut self, threads: Threads) {
        self.threads = threads_for(self.critics.layout(), self.settings.batch, threads);
    }

    fn gradient_step(&mut self, batch: &Minibatch) -> Losses {
        let mut noise = std::mem::replace(&mut self.noise, DMatrix::zeros(0, 0));
        let stream = seek(&mut self.stream, self.updates);
        noise
            .iter_mut()
            .for_each(|normal| *normal = stream.sample(StandardNormal));
        let losses = self.update(batch, &noise);
        self.noise = noise;
        losses
    }

    fn state(&self) -> Vec<StateArray<'_>> {
        let NetworkWithTarget { online, target } = &self.actor;
        let (m, v) = (&online.adam.first_moment, &online.adam.second_moment);
        let actor: [&[f32]; 4] = [&online.parameters, target, m, v];
        let names = ACTOR.into_iter().chain(twin_critics::ARRAYS.into_iter().flatten());
        let arrays = actor.into_iter().chain(self.critics.arrays().into_iter().flatten());
        names.zip(arrays).collect()
    }

    fn state_mut(&mut self, updates: u64) -> Vec<StateArrayMut<'_>> {
        self.updates = updates;
        let NetworkWithTarget { online, target } = &mut self.actor;
        let (m, v) = (&mut online.adam.first_moment, &mut online.adam.second_moment);
        let actor: [&mut [f32]; 4] = [&mut online.parameters, target, m, v];
        let names = ACTOR.into_iter().chain(twin_critics::ARRAYS.into_iter().flatten());
        let arrays = actor.into_iter().chain(self.critics.arrays_mut().into_iter().flatten());
        names.zip(arrays).collect()
    }
}

impl AlgorithmDefinition for &config::Td3Config {
    fn create(&self, config: &Config) -> Result<Box<dyn Algorithm>, PolicyError> {
        let td3 = Td3::new(&config.spec, self, config.run.seed)?;
        Ok(Box::new(SampledAlgorithm::new(td3, config)?))
    }

    fn weight_names(&self) -> &'static [&'static str] {
        &WEIGHTS
    }

    fn products(&self, spec: &EnvironmentSpec) -> Products {
        let ActorCritic { actor: mu, critic: q } = &self.networks(spec);
        let batch = self.batch;
        let of_critics = || product::forward(mu, batch).chain(twin_critics::products(q, batch));
        let of_actor = (product::forward(mu, batch).chain(product::forward(q, batch)))
            .chain(product::backward_to_actions(q, batch))
            .chain(product::backward(mu, batch));
        let delay = self.policy_delay;
        Products {
            updates: delay,
            products: (0..delay).flat_map(|_| of_critics()).chain(of_actor).collect(),
        }
    }

    fn state_numbers(&self, spec: &EnvironmentSpec, _: RunSizes) -> usize {
        // Each network with its target and two moments.
        4 * self.learned_shapes(spec).parameters()
    }
}

#[cfg(test)]
mod tests;
