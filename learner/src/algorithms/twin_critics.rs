//! Two critics with their targets, as TD3 and SAC have them: Q₁ and Q₂ over (s, a), with a scaled to [−1, 1]. The
//! targets use the smaller of their values (clipped double Q-learning, Fujimoto et al. 2018, section 4.2).

use nalgebra::{DMatrix, DVector};
use shoal_common::network::{ActionRange, NetworkLayout};

use super::minibatch::Minibatch;
use super::minibatch_algorithm::{mean, targets};
use crate::networks::initialise::fan_in;
use crate::networks::pass::{Pass, Samples};
use crate::networks::product::{self, Product};
use crate::networks::threads::Threads;
use crate::networks::trainable::NetworkWithTarget;

/// The names of the critics' arrays in a checkpoint: parameters, target, moments.
pub(super) const ARRAYS: [[&str; 4]; 2] = [
    [
        "critic 1",
        "target critic 1",
        "critic 1's first moment",
        "critic 1's second moment",
    ],
    [
        "critic 2",
        "target critic 2",
        "critic 2's first moment",
        "critic 2's second moment",
    ],
];

/// A critic with its buffers for a minibatch.
#[derive(Clone, Debug)]
pub(super) struct Critic {
    pub(super) network: NetworkWithTarget,
    /// Its pass over the minibatch and, later in an update, over the policy's actions.
    pub(super) q: Pass,
    target_q: Pass,
    /// ∂L/∂Q.
    d_q: DMatrix<f32>,
    /// ∂L/∂a of the policy's actions.
    d_a: DMatrix<f32>,
}

impl Critic {
    /// The first `cut` samples, and the others.
    pub(super) fn split_at(&mut self, cut: usize) -> (CriticPart<'_>, CriticPart<'_>) {
        let width = self.d_a.nrows();
        let theta = &*self.network.online.parameters;
        let q = self.q.samples().split_at(cut);
        let d_q = self.d_q.as_mut_slice().split_at_mut(cut);
        let d_a = self.d_a.as_mut_slice().split_at_mut(cut * width);
        let part = |q, d_q, d_a| CriticPart { theta, q, d_q, d_a };
        (part(q.0, d_q.0, d_a.0), part(q.1, d_q.1, d_a.1))
    }
}

/// Some samples of a critic, to improve the policy's actions with.
pub(super) struct CriticPart<'a> {
    theta: &'a [f32],
    q: Samples<'a>,
    /// ∂L/∂Q, to be filled in.
    pub(super) d_q: &'a mut [f32],
    /// ∂L/∂a after [`backward`](Self::backward).
    pub(super) d_a: &'a mut [f32],
}

impl CriticPart<'_> {
    /// Computes Q(s, a).
    pub(super) fn forward(&mut self, s: &[f32], a: &[f32]) {
        self.q.forward(self.theta, s, a);
    }

    /// Q of the forward pass, a number for each sample.
    pub(super) fn values(&self) -> &[f32] {
        self.q.output
    }

    /// Computes `d_a` from `d_q`.
    pub(super) fn backward(&mut self) {
        self.q.backward_to_actions(self.theta, self.d_q, self.d_a);
    }
}

/// Both critics.
#[derive(Clone, Debug)]
pub(super) struct TwinCritics {
    pub(super) critics: [Critic; 2],
    /// The actions of the minibatch, scaled.
    a: DMatrix<f32>,
    y: DVector<f32>,
}

/// What a step of the critics reports.
#[derive(Clone, Copy, Debug)]
pub(super) struct CriticLosses {
    /// The sum of both mean squared errors.
    pub(super) loss: f32,
    /// The mean of Q₁ before the step.
    pub(super) q_mean: f32,
}

impl TwinCritics {
    /// New critics, drawn from networks 1 and 2 of `seed`, for minibatches of `batch` transitions.
    pub(super) fn new(layout: NetworkLayout, learning_rate: f64, batch: usize, seed: u64) -> Self {
        let action = layout.action_inputs();
        let critic = |index| Critic {
            network: NetworkWithTarget::new(layout, learning_rate, &fan_in(&layout, seed, index)),
            q: Pass::new(layout, batch),
            target_q: Pass::new(layout, batch),
            d_q: DMatrix::zeros(1, batch),
            d_a: DMatrix::zeros(action, batch),
        };
        Self {
            critics: [1, 2].map(critic),
            a: DMatrix::zeros(action, batch),
            y: DVector::zeros(batch),
        }
    }

    /// The layout of one critic.
    pub(super) fn layout(&self) -> &NetworkLayout {
        &self.critics[0].network.online.layout
    }

    /// Minimises the sum over both critics of 1/N Σ (y − Q(s, a))² by one step, number `t`, where y = r + discount ·
    /// (min Q'(s', a') + `bonus`). `a_next` are the scaled actions a', `bonus` is a number for each sample. The targets
    /// follow with τ, if it is given. Each of two threads updates one critic.
    pub(super) fn step(
        &mut self,
        threads: &Threads,
        t: u64,
        tau: Option<f32>,
        batch: &Minibatch,
        range: &ActionRange,
        (a_next, bonus): (&DMatrix<f32>, &DVector<f32>),
    ) -> CriticLosses {
        let Self {
            critics: [first, second],
            a,
            y,
        } = self;
        scale(range, batch.a.as_slice(), a.as_mut_slice());
        let (a, s) = (&*a, batch.s.as_slice());
        let evaluate = |critic: &mut Critic| {
            let Critic {
                network, q, target_q, ..
            } = critic;
            target_q.forward(&network.target, batch.s_next.as_slice(), a_next.as_slice());
            q.forward(&network.online.parameters, s, a.as_slice());
        };
        threads.both(|| evaluate(first), || evaluate(second));
        let least = |i: usize| first.target_q.output[i].min(second.target_q.output[i]) + bonus[i];
        targets(batch, least, y);
        let q_mean = mean(first.q.output.iter().copied());
        let loss = |critic: &Critic| mean(critic.q.output.iter().zip(&*y).map(|(q, y)| (y - q) * (y - q)));
        let loss = loss(first) + loss(second);
        let step = |critic: &mut Critic| {
            let Critic { network, q, d_q, .. } = critic;
            let scale = 2.0 / y.len() as f32;
            for (d, (q, y)) in d_q.iter_mut().zip(q.output.iter().zip(&*y)) {
                *d = scale * (q - y);
            }
            let online = &mut network.online;
            q.backward(&Threads::SINGLE, &online.parameters, s, d_q, &mut online.gradient);
            match tau {
                Some(tau) => network.step_with_target(&Threads::SINGLE, t, tau),
                None => network.online.step(&Threads::SINGLE, t),
            }
        };
        threads.both(|| step(first), || step(second));
        CriticLosses { loss, q_mean }
    }

    /// Their arrays, in the order of [`ARRAYS`].
    pub(super) fn arrays(&self) -> [[&[f32]; 4]; 2] {
        self.critics.each_ref().map(|critic| {
            let NetworkWithTarget { online, target } = &critic.network;
            let (m, v) = (&online.adam.first_moment, &online.adam.second_moment);
            [&*online.parameters, target, m, v]
        })
    }

    /// As [`arrays`](Self::arrays).
    pub(super) fn arrays_mut(&mut self) -> [[&mut [f32]; 4]; 2] {
        self.critics.each_mut().map(|critic| {
            let NetworkWithTarget { online, target } = &mut critic.network;
            let (m, v) = (&mut online.adam.first_moment, &mut online.adam.second_moment);
            [&mut *online.parameters, &mut *target, &mut *m, &mut *v]
        })
    }
}

/// The matrix products of [`TwinCritics::step`].
pub(super) fn products(critic: &NetworkLayout, batch: usize) -> impl Iterator<Item = Product> {
    (0..2).flat_map(move |_| {
        product::forward(critic, batch)
            .chain(product::forward(critic, batch))
            .chain(product::backward(critic, batch))
    })
}

/// Scales actions from their range to [−1, 1].
fn scale(range: &ActionRange, actions: &[f32], scaled: &mut [f32]) {
    let width = range.width();
    for (to, action) in scaled.chunks_exact_mut(width).zip(actions.chunks_exact(width)) {
        for (element, (to, a)) in to.iter_mut().zip(action).enumerate() {
            *to = range.unscaled(element, *a);
        }
    }
}
