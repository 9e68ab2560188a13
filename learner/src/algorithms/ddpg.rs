//! Deep deterministic policy gradient: Algorithm 4 of the thesis (section 3.4.3), after Lillicrap et al. 2015.
//!
//! Symbols as there: policy μ with parameters θ_μ, action-value function Q with θ_Q, their slowly following targets μ'
//! and Q', batch size N, target y, loss L, target rate τ. Lines 1, 2 and 11 to 16 are here. The others run in the
//! actors and environment servers.

use nalgebra::{DMatrix, DVector};
use shoal_common::algorithms::{ActorCritic, AlgorithmSettings};
use shoal_common::config::{self, Config};
use shoal_common::network::{ActionRange, NetworkLayout};
use shoal_common::policy::PolicyError;
use shoal_common::space::EnvironmentSpec;

use super::algorithm::{Algorithm, AlgorithmDefinition, Losses, RunSizes, StateArray, StateArrayMut};
use super::minibatch::Minibatch;
use super::minibatch_algorithm::{MinibatchAlgorithm, SampledAlgorithm, mean, targets};
use crate::networks::digest::sha256;
use crate::networks::initialise::small_output;
use crate::networks::pass::{Pass, Samples};
use crate::networks::product::{self, Products};
use crate::networks::threads::Threads;
use crate::networks::trainable::{NetworkWithTarget, threads_for};

/// The arrays of the algorithm's state, as named in a checkpoint.
const ARRAYS: [&str; 8] = [
    "actor",
    "critic",
    "target actor",
    "target critic",
    "actor's first moment",
    "actor's second moment",
    "critic's first moment",
    "critic's second moment",
];

/// The state of DDPG: both networks, their targets, both optimisers.
#[derive(Clone, Debug)]
pub struct Ddpg {
    range: ActionRange,
    tau: f32,
    threads: Threads,
    updates: u64,
    actor: NetworkWithTarget,
    critic: NetworkWithTarget,
    // Buffers for the intermediate results of a gradient step.
    mu: Pass,
    q: Pass,
    target_mu: Pass,
    target_q: Pass,
    actions: DMatrix<f32>,
    target_actions: DMatrix<f32>,
    y: DVector<f32>,
    d_q: DMatrix<f32>,
    d_mu: DMatrix<f32>,
}

impl Ddpg {
    /// New networks, drawn from `seed`. The settings come from a checked configuration.
    ///
    /// # Errors
    /// When the environment's actions are not real numbers in finite ranges.
    pub fn new(spec: &EnvironmentSpec, settings: &config::DdpgConfig, seed: u64) -> Result<Self, PolicyError> {
        let range = ActionRange::new(&spec.action)?;
        let ActorCritic { actor: mu, critic: q } = settings.networks(spec);
        let (action, batch) = (range.width(), settings.batch);
        Ok(Self {
            range,
            tau: settings.tau as f32,
            threads: Threads::SINGLE,
            updates: 0,
            // Lines 1 and 2: θ at random, θ' ← θ.
            actor: NetworkWithTarget::new(mu, settings.actor_learning_rate, &small_output(&mu, seed, 0)),
            critic: NetworkWithTarget::new(q, settings.critic_learning_rate, &small_output(&q, seed, 1)),
            mu: Pass::new(mu, batch),
            q: Pass::new(q, batch),
            target_mu: Pass::new(mu, batch),
            target_q: Pass::new(q, batch),
            actions: DMatrix::zeros(action, batch),
            target_actions: DMatrix::zeros(action, batch),
            y: DVector::zeros(batch),
            d_q: DMatrix::zeros(1, batch),
            d_mu: DMatrix::zeros(action, batch),
        })
    }

    /// Takes a gradient step with a minibatch of N transitions: lines 12 to 16. Returns L of line 13, −mean of Q(s,
    /// μ(s)) with Q after its step, and the mean of Q(s, a) with Q before it. Panics if the batch has other dimensions
    /// than the networks and settings. Nothing is allocated.
    pub fn update(&mut self, batch: &Minibatch) -> Losses {
        assert_eq!(batch.size(), self.y.len(), "transitions in the minibatch");
        let t = self.updates + 1;
        self.evaluate(batch);
        let (critic_loss, q_mean) = self.critic_gradient(batch);
        // Lines 13 and 15 in one sweep: Q' is not read again in this update. Likewise μ' of lines 14 and 16.
        self.critic.step_with_target(&self.threads, t, self.tau);
        let actor_loss = self.actor_gradient(&batch.s);
        self.actor.step_with_target(&self.threads, t, self.tau);
        self.updates = t;
        Losses {
            critic_loss,
            actor_loss,
            q_mean,
            ..Losses::default()
        }
    }

    /// Evaluates the four networks before any of them changes: one thread computes μ(s) and Q(s, a), the other one
    /// Q'(s', μ'(s')). Then line 12: y = r + discount · Q'(s', μ'(s')). The value of a terminal s' is not used, even if
    /// it is NaN.
    fn evaluate(&mut self, batch: &Minibatch) {
        let (actor, critic, range) = (&self.actor, &self.critic, &self.range);
        let (s, a, s_next) = (batch.s.as_slice(), batch.a.as_slice(), batch.s_next.as_slice());
        let (mu, q, actions) = (&mut self.mu, &mut self.q, &mut self.actions);
        let (target_mu, target_q, target_actions) = (&mut self.target_mu, &mut self.target_q, &mut self.target_actions);
        self.threads.both(
            || {
                act(mu, range, &actor.online.parameters, s, actions);
                q.forward(&critic.online.parameters, s, a);
            },
            || {
                act(target_mu, range, &actor.target, s_next, target_actions);
                target_q.forward(&critic.target, s_next, target_actions.as_slice());
            },
        );
        targets(batch, |i| self.target_q.output[i], &mut self.y);
    }

    /// Line 13: the gradient of L = 1/N Σ (y − Q(s, a))², through ∂L/∂Q = 2/N (Q − y). Returns L and the mean of Q.
    fn critic_gradient(&mut self, batch: &Minibatch) -> (f32, f32) {
        let scale = 2.0 / batch.size() as f32;
        for (d, (q, y)) in self.d_q.iter_mut().zip(self.q.output.iter().zip(&self.y)) {
            *d = scale * (q - y);
        }
        let critic = &mut self.critic.online;
        let (parameters, gradient) = (&critic.parameters, &mut critic.gradient);
        self.q
            .backward(&self.threads, parameters, batch.s.as_slice(), &self.d_q, gradient);
        let loss = mean(self.q.output.iter().zip(&self.y).map(|(q, y)| (y - q) * (y - q)));
        (loss, mean(self.q.output.iter().copied()))
    }

    /// Line 14 and equation 3.30: the gradient of the loss −1/N Σ Q(s, μ(s)), with the critic after line 13: ∇_a Q ·
    /// ∇_θμ μ. Returns the loss. Up to the gradients of θ_μ the samples are independent, and the threads share them.
    fn actor_gradient(&mut self, s: &DMatrix<f32>) -> f32 {
        let (actor, critic, half) = (&self.actor.online, &self.critic.online, self.range.half());
        self.d_q.fill(-1.0 / self.y.len() as f32);
        let cut = self.threads.first_share(self.y.len());
        let per_sample = |matrix: &DMatrix<f32>| cut * matrix.nrows();
        let part = |mut mu: Samples<'_>, mut q: Samples<'_>, s, actions, d_q, d_mu: &mut [f32]| {
            q.forward(&critic.parameters, s, actions);
            q.backward_to_actions(&critic.parameters, d_q, d_mu);
            // a = centre + half · tanh z, so ∂a/∂z = half · (1 − tanh² z)
            for (d, tanh) in d_mu
                .chunks_exact_mut(half.len())
                .zip(mu.output.chunks_exact(half.len()))
            {
                for ((d, tanh), half) in d.iter_mut().zip(tanh).zip(half) {
                    *d *= half * (1.0 - tanh * tanh);
                }
            }
            mu.backward(&actor.parameters, d_mu, 1);
        };
        let observations = s.as_slice().split_at(per_sample(s));
        let actions = self.actions.as_slice().split_at(per_sample(&self.actions));
        let d_q = self.d_q.as_slice().split_at(cut);
        let d_mu = per_sample(&self.d_mu);
        let d_mu = self.d_mu.as_mut_slice().split_at_mut(d_mu);
        let (mu, q) = (self.mu.samples().split_at(cut), self.q.samples().split_at(cut));
        self.threads.both(
            || part(mu.0, q.0, observations.0, actions.0, d_q.0, d_mu.0),
            || part(mu.1, q.1, observations.1, actions.1, d_q.1, d_mu.1),
        );
        let actor = &mut self.actor.online;
        let (parameters, gradient) = (&actor.parameters, &mut actor.gradient);
        self.mu
            .gradients(&self.threads, parameters, s.as_slice(), &self.d_mu, gradient);
        -mean(self.q.output.iter().copied())
    }

    /// The layouts of the actor's and the critic's parameters.
    pub fn layouts(&self) -> (&NetworkLayout, &NetworkLayout) {
        (&self.actor.online.layout, &self.critic.online.layout)
    }

    /// SHA-256 over actor, critic, target actor and target critic as little-endian `f32`, in hexadecimal.
    pub fn digest(&self) -> String {
        sha256(&self.arrays()[..4])
    }

    /// In the order of [`ARRAYS`].
    fn arrays(&self) -> [&[f32]; 8] {
        let (actor, critic) = (&self.actor, &self.critic);
        [
            &actor.online.parameters,
            &critic.online.parameters,
            &actor.target,
            &critic.target,
            &actor.online.adam.first_moment,
            &actor.online.adam.second_moment,
            &critic.online.adam.first_moment,
            &critic.online.adam.second_moment,
        ]
    }
}

impl MinibatchAlgorithm for Ddpg {
    fn policy(&self) -> &[f32] {
        &self.actor.online.parameters
    }

    fn updates(&self) -> u64 {
        self.updates
    }

    fn set_threads(&mut self, threads: Threads) {
        self.threads = threads_for(&self.critic.online.layout, self.y.len(), threads);
    }

    fn gradient_step(&mut self, batch: &Minibatch) -> Losses {
        self.update(batch)
    }

    fn state(&self) -> Vec<StateArray<'_>> {
        ARRAYS.into_iter().zip(self.arrays()).collect()
    }

    fn state_mut(&mut self, updates: u64) -> Vec<StateArrayMut<'_>> {
        self.updates = updates;
        let (actor, critic) = (&mut self.actor, &mut self.critic);
        let arrays: [&mut [f32]; 8] = [
            &mut actor.online.parameters,
            &mut critic.online.parameters,
            &mut actor.target,
            &mut critic.target,
            &mut actor.online.adam.first_moment,
            &mut actor.online.adam.second_moment,
            &mut critic.online.adam.first_moment,
            &mut critic.online.adam.second_moment,
        ];
        ARRAYS.into_iter().zip(arrays).collect()
    }
}

impl AlgorithmDefinition for &config::DdpgConfig {
    fn create(&self, config: &Config) -> Result<Box<dyn Algorithm>, PolicyError> {
        let ddpg = Ddpg::new(&config.spec, self, config.run.seed)?;
        Ok(Box::new(SampledAlgorithm::new(ddpg, config)?))
    }

    fn weight_names(&self) -> &'static [&'static str] {
        &ARRAYS[..4]
    }

    /// With the thesis's networks, three observations and a batch of 64 they take 140 million operations, nearly all of
    /// them in nine products of size 300 × 400 × 64.
    fn products(&self, spec: &EnvironmentSpec) -> Products {
        let ActorCritic { actor: mu, critic: q } = &self.networks(spec);
        let batch = self.batch;
        let both = || product::forward(mu, batch).chain(product::forward(q, batch));
        let products = (both()
            .chain(product::forward(q, batch))
            .chain(product::backward(q, batch)))
        .chain(both())
        .chain(product::backward_to_actions(q, batch))
        .chain(product::backward(mu, batch));
        Products {
            updates: 1,
            products: products.collect(),
        }
    }

    fn state_numbers(&self, spec: &EnvironmentSpec, _: RunSizes) -> usize {
        // Each network with its target and two moments.
        4 * self.learned_shapes(spec).parameters()
    }
}

/// Fills `actions` with the policy's actions, in environment units, and leaves their tanh in `mu.output`. The bits are
/// the same as with [`DeterministicPolicy`](shoal_common::network::DeterministicPolicy).
fn act(mu: &mut Pass, range: &ActionRange, parameters: &[f32], s: &[f32], actions: &mut DMatrix<f32>) {
    mu.forward(parameters, s, &[]);
    for (mut action, mut z) in actions.column_iter_mut().zip(mu.output.column_iter_mut()) {
        for element in 0..range.width() {
            z[element] = z[element].tanh();
            action[element] = range.action(element, z[element]);
        }
    }
}

#[cfg(test)]
mod tests;
