//! Deep deterministic policy gradient: Algorithm 4 of the thesis (section 3.4.3), after Lillicrap et al. 2015.
//!
//! Symbols as there: policy μ with parameters θ_μ, action-value function Q with θ_Q, their slowly following targets μ'
//! and Q', batch size N, target y, loss L, target rate τ. Lines 1, 2 and 11 to 16 are here. The others run in the
//! actors and environment servers.

pub mod replayed;

use nalgebra::{DMatrix, DVector};
use shoal_common::config;
use shoal_common::network::{ActionRange, NetworkLayout};
use shoal_common::policy::PolicyError;
use shoal_common::space::EnvironmentSpec;

use super::algorithm::{Losses, SectionError};
use super::minibatch::Minibatch;
use crate::networks::adam::Adam;
use crate::networks::aligned::Aligned;
use crate::networks::digest::sha256;
use crate::networks::initialise::initialise;
use crate::networks::pass::{Pass, Samples};
use crate::networks::product;
use crate::networks::threads::Threads;

/// Everything that a gradient step changes, as stored in a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DdpgState<'a> {
    /// Gradient steps taken.
    pub updates: u64,
    /// Flat numbers, in the order of [`DdpgState::PARTS`].
    pub parts: [&'a [f32]; 8],
}

impl DdpgState<'_> {
    /// The names of the parts.
    pub const PARTS: [&'static str; 8] = [
        "actor",
        "critic",
        "target actor",
        "target critic",
        "actor's first moment",
        "actor's second moment",
        "critic's first moment",
        "critic's second moment",
    ];
}

/// A network, the target network that follows it, and the state of its optimiser.
#[derive(Clone, Debug)]
struct Learned {
    layout: NetworkLayout,
    parameters: Aligned,
    target: Aligned,
    adam: Adam,
    gradient: Aligned,
}

impl Learned {
    /// Lines 1 and 2: θ at random, θ' ← θ.
    fn new(layout: NetworkLayout, learning_rate: f64, seed: u64, index: u64) -> Self {
        let parameters = initialise(&layout, seed, index);
        Self {
            layout,
            parameters: Aligned::from_slice(&parameters, 0),
            target: Aligned::from_slice(&parameters, 1),
            gradient: Aligned::zeros(parameters.len(), 2),
            adam: Adam::new(learning_rate, parameters.len()),
        }
    }

    /// Takes one step of Adam against the gradient, and then the step of the target.
    fn descend(&mut self, threads: &Threads, t: u64, tau: f32) {
        self.adam
            .step(threads, t, &self.gradient, &mut self.parameters, tau, &mut self.target);
    }
}

/// Two threads are used only if there are at least this many samples, and units in each hidden layer but the last (or
/// in the only one). If a dimension is 1 or the product is small, faer adds the terms of a transposed product in
/// another order, and the bits must not depend on the number of threads.
const MIN_SPLIT: usize = 4;
/// As [`MIN_SPLIT`], for samples times units of each hidden layer but the first (or of the only one).
const MIN_WORK: usize = 8_192;

/// The learner of DDPG: both networks, their targets, both optimisers.
#[derive(Clone, Debug)]
pub struct Ddpg {
    range: ActionRange,
    tau: f32,
    threads: Threads,
    updates: u64,
    actor: Learned,
    critic: Learned,
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
    /// New networks, drawn from `seed`. The settings are those of a checked configuration.
    ///
    /// # Errors
    /// When the environment's actions are not real numbers in finite ranges.
    pub fn new(spec: &EnvironmentSpec, settings: &config::DdpgConfig, seed: u64) -> Result<Self, PolicyError> {
        let range = ActionRange::new(&spec.action)?;
        let (observation, action, batch) = (spec.observation.width(), range.width(), settings.batch);
        let mu = NetworkLayout::policy(observation, settings.hidden_layers(), action);
        let q = NetworkLayout::critic(observation, settings.hidden_layers(), action);
        Ok(Self {
            range,
            tau: settings.tau as f32,
            threads: Threads::ALONE,
            updates: 0,
            actor: Learned::new(mu, settings.actor_learning_rate, seed, 0),
            critic: Learned::new(q, settings.critic_learning_rate, seed, 1),
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

    /// Shares the work of a gradient step among these threads from now on, if there is enough of it. The bits of the
    /// results do not depend on them.
    pub fn set_threads(&mut self, threads: Threads) {
        let (layers, batch) = (self.critic.layout.hidden().layers, self.y.len());
        let others = layers.len() - 1;
        let (all_but_last, all_but_first) = (&layers[..others.max(1)], &layers[others.min(1)..]);
        let enough = batch >= MIN_SPLIT
            && all_but_last.iter().all(|units| *units >= MIN_SPLIT)
            && all_but_first.iter().all(|units| units * batch >= MIN_WORK);
        self.threads = if enough { threads } else { Threads::ALONE };
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
        self.critic.descend(&self.threads, t, self.tau);
        let actor_loss = self.actor_gradient(&batch.s);
        self.actor.descend(&self.threads, t, self.tau);
        self.updates = t;
        Losses {
            critic_loss,
            actor_loss,
            q_mean,
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
                act(mu, range, &actor.parameters, s, actions);
                q.forward(&critic.parameters, s, a);
            },
            || {
                act(target_mu, range, &actor.target, s_next, target_actions);
                target_q.forward(&critic.target, s_next, target_actions.as_slice());
            },
        );
        for (i, y) in self.y.iter_mut().enumerate() {
            let discount = batch.discount[i];
            *y = batch.r[i]
                + if discount == 0.0 {
                    0.0
                } else {
                    discount * self.target_q.output[i]
                };
        }
    }

    /// Line 13: the gradient of L = 1/N Σ (y − Q(s, a))², through ∂L/∂Q = 2/N (Q − y). Returns L and the mean of Q.
    fn critic_gradient(&mut self, batch: &Minibatch) -> (f32, f32) {
        let scale = 2.0 / batch.size() as f32;
        for (d, (q, y)) in self.d_q.iter_mut().zip(self.q.output.iter().zip(&self.y)) {
            *d = scale * (q - y);
        }
        let (parameters, gradient) = (&self.critic.parameters, &mut self.critic.gradient);
        self.q
            .backward(&self.threads, parameters, batch.s.as_slice(), &self.d_q, gradient);
        let loss = mean(self.q.output.iter().zip(&self.y).map(|(q, y)| (y - q) * (y - q)));
        (loss, mean(self.q.output.iter().copied()))
    }

    /// Line 14 and equation 3.30: the gradient of the loss −1/N Σ Q(s, μ(s)), with the critic after line 13: ∇_a Q ·
    /// ∇_θμ μ. Returns the loss. Up to the gradients of θ_μ the samples are independent, and the threads share them.
    fn actor_gradient(&mut self, s: &DMatrix<f32>) -> f32 {
        let (actor, critic, half) = (&self.actor, &self.critic, self.range.half());
        self.d_q.fill(-1.0 / self.y.len() as f32);
        let cut = self.threads.first_share(self.y.len());
        let per_sample = |matrix: &DMatrix<f32>| cut * matrix.nrows();
        let part = |mut mu: Samples<'_>, mut q: Samples<'_>, s, actions, d_q, d_mu: &mut [f32]| {
            q.forward(&critic.parameters, s, actions);
            q.backward_to_late_inputs(&critic.parameters, d_q, d_mu);
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
        let (parameters, gradient) = (&self.actor.parameters, &mut self.actor.gradient);
        self.mu
            .gradients(&self.threads, parameters, s.as_slice(), &self.d_mu, gradient);
        -mean(self.q.output.iter().copied())
    }

    /// θ_μ, the policy's parameters, in the layout [`policy_layout`](Self::policy_layout).
    pub fn policy(&self) -> &[f32] {
        &self.actor.parameters
    }

    /// The layout of the policy's parameters.
    pub fn policy_layout(&self) -> &NetworkLayout {
        &self.actor.layout
    }

    /// The layout of the critic's parameters.
    pub fn critic_layout(&self) -> &NetworkLayout {
        &self.critic.layout
    }

    /// Gradient steps taken.
    pub fn updates(&self) -> u64 {
        self.updates
    }

    /// SHA-256 over actor, critic, target actor and target critic as little-endian `f32`, in hexadecimal.
    pub fn digest(&self) -> String {
        sha256(&self.state().parts[..4])
    }

    /// Floating-point operations of the matrix products of one gradient step.
    pub fn flop_per_update(&self) -> u64 {
        product::flop_per_update(&self.actor.layout, &self.critic.layout, self.y.len())
    }

    /// Everything that the next gradient step depends on.
    pub fn state(&self) -> DdpgState<'_> {
        let (actor, critic) = (&self.actor, &self.critic);
        DdpgState {
            updates: self.updates,
            parts: [
                &actor.parameters,
                &critic.parameters,
                &actor.target,
                &critic.target,
                &actor.adam.first_moment,
                &actor.adam.second_moment,
                &critic.adam.first_moment,
                &critic.adam.second_moment,
            ],
        }
    }

    /// Starts again from given networks (actor, critic, target actor, target critic), with optimisers before their
    /// first step.
    ///
    /// # Errors
    /// When their sizes differ; then nothing has changed.
    pub fn restart_from(&mut self, networks: [&[f32]; 4]) -> Result<(), SectionError> {
        let [actor, critic] =
            [self.actor.parameters.len(), self.critic.parameters.len()].map(|length| vec![0.0; length]);
        let [mu, q, target_mu, target_q] = networks;
        self.restore(&DdpgState {
            updates: 0,
            parts: [mu, q, target_mu, target_q, &actor, &actor, &critic, &critic],
        })
    }

    /// Restores a state of this or of another [`Ddpg`] with networks of the same sizes.
    ///
    /// # Errors
    /// When the sizes differ; then nothing has changed.
    pub fn restore(&mut self, state: &DdpgState<'_>) -> Result<(), SectionError> {
        for ((part, own), given) in DdpgState::PARTS.into_iter().zip(self.state().parts).zip(state.parts) {
            if given.len() != own.len() {
                return Err(SectionError::of_length(part, given.len(), own.len()));
            }
        }
        let (actor, critic) = (&mut self.actor, &mut self.critic);
        let own = [
            &mut actor.parameters,
            &mut critic.parameters,
            &mut actor.target,
            &mut critic.target,
            &mut actor.adam.first_moment,
            &mut actor.adam.second_moment,
            &mut critic.adam.first_moment,
            &mut critic.adam.second_moment,
        ];
        for (own, given) in own.into_iter().zip(state.parts) {
            own.copy_from_slice(given);
        }
        self.updates = state.updates;
        Ok(())
    }
}

/// Fills `actions` with the policy's actions, in environment units, and leaves their tanh in `mu.output`. The bits are
/// those of [`PolicyNetwork`](shoal_common::network::PolicyNetwork).
fn act(mu: &mut Pass, range: &ActionRange, parameters: &[f32], s: &[f32], actions: &mut DMatrix<f32>) {
    mu.forward(parameters, s, &[]);
    for (mut action, mut z) in actions.column_iter_mut().zip(mu.output.column_iter_mut()) {
        for element in 0..range.width() {
            z[element] = z[element].tanh();
            action[element] = range.action(element, z[element]);
        }
    }
}

fn mean(numbers: impl ExactSizeIterator<Item = f32>) -> f32 {
    let count = numbers.len() as f32;
    numbers.sum::<f32>() / count
}

#[cfg(test)]
mod tests;
