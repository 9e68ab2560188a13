//! REINFORCE: Algorithm 3 (section 3.4.1), its variants of section 4.2.2, and the baseline of equation 3.25.
//!
//! Symbols as there: policy π with parameters θ, return G, baseline V with parameters θ_v, δ = G − V(s).
//!
//! Algorithm 3 leaves some choices open. Here, line 6 is averaged over the time steps of an episode, and Adam takes one
//! step per episode: the whole episode was collected with the policy that the step changes. With several actors, a
//! round has one episode of each, and the step follows the mean of their gradients. `docs/REPRODUCTION.md` describes
//! the effect of other choices.

use std::borrow::Cow;

use nalgebra::DMatrix;
use shoal_common::algorithms::{AlgorithmSettings, ReinforceNetworks};
use shoal_common::config::{self, Config, ReturnWeighting};
use shoal_common::network::NetworkLayout;
use shoal_common::numbers::are_finite;
use shoal_common::policy::{self, PolicyError, PolicyLayout};
use shoal_common::space::EnvironmentSpec;
use shoal_common::transition::Transition;

use super::algorithm::{Algorithm, AlgorithmDefinition, Losses, RunSizes, SavedState, StateArray, StateArrayError};
use crate::networks::initialise::glorot;
use crate::networks::pass::Pass;
use crate::networks::threads::Threads;
use crate::networks::trainable::TrainableNetwork;
use crate::replay::Replay;

/// Added to a standard deviation before dividing by it. An episode whose returns are all equal then has no weight.
const STD_FLOOR: f32 = 1e-8;

/// A network that learns, with its pass over the steps of a round.
#[derive(Clone, Debug)]
struct NetworkWithPass {
    network: TrainableNetwork,
    pass: Pass,
    /// ∂L/∂output
    d: DMatrix<f32>,
}

impl NetworkWithPass {
    fn new(layout: NetworkLayout, learning_rate: f64, seed: u64, index: u64, steps: usize) -> Self {
        Self {
            network: TrainableNetwork::new(layout, learning_rate, &glorot(&layout, seed, index)),
            pass: Pass::new(layout, steps),
            d: DMatrix::zeros(layout.outputs(), steps),
        }
    }

    fn forward(&mut self, s: &DMatrix<f32>) {
        self.pass.forward(&self.network.parameters, s.as_slice(), &[]);
    }

    /// Takes one step of Adam. The gradient is that of the last forward pass and of the first `steps` columns of `d`.
    fn step(&mut self, t: u64, steps: usize, s: &DMatrix<f32>) {
        self.d.columns_mut(steps, s.ncols() - steps).fill(0.0);
        self.pass.backward(
            &Threads::SINGLE,
            &self.network.parameters,
            s.as_slice(),
            &self.d,
            &mut self.network.gradient,
        );
        self.network.step(&Threads::SINGLE, t);
    }
}

/// The state of REINFORCE.
#[derive(Clone, Debug)]
pub struct Reinforce {
    settings: config::ReinforceConfig,
    policy: NetworkWithPass,
    baseline: Option<NetworkWithPass>,
    /// Rows learned from.
    rows: u64,
    /// Steps taken by Adam, as stored in a checkpoint. The `f32` is exact up to 2²⁴, more episodes than any run has.
    steps: [f32; 1],
    /// A buffer for the observations of a round, one column per time step.
    s: DMatrix<f32>,
}

impl Reinforce {
    /// Names of the arrays that hold what was learned.
    const WEIGHTS: [&'static str; 2] = ["policy", "baseline"];
    const MOMENTS: [[&'static str; 2]; 2] = [
        ["policy's first moment", "policy's second moment"],
        ["baseline's first moment", "baseline's second moment"],
    ];
    const STEPS: &'static str = "steps of Adam";

    /// New networks, drawn from `seed`, for an environment like `spec`.
    ///
    /// # Errors
    /// When it has continuous actions or discrete observations.
    pub fn new(
        settings: &config::ReinforceConfig,
        spec: &EnvironmentSpec,
        seed: u64,
        sizes: RunSizes,
    ) -> Result<Self, PolicyError> {
        let ReinforceNetworks { policy, baseline } = settings.networks(spec);
        policy::softmax(policy, spec, 0)?;
        let steps = sizes.chunk_rows * sizes.actors as usize;
        Ok(Self {
            policy: NetworkWithPass::new(policy, settings.learning_rate, seed, 0, steps),
            baseline: baseline
                .map(|network| NetworkWithPass::new(network, settings.baseline_learning_rate, seed, 1, steps)),
            settings: settings.clone(),
            rows: 0,
            steps: [0.0],
            s: DMatrix::zeros(policy.inputs(), steps),
        })
    }

    /// Lines 4 to 7 for the episodes of a round, one after another. Returns the means, over episodes and their steps,
    /// of δ² (0 without a baseline), of −weight · ln π, and of G; `None` if no episode is learned from.
    fn learn(&mut self, steps: &[Transition<'_>]) -> Option<Losses> {
        let episodes: Vec<&[Transition<'_>]> = steps
            .split_inclusive(|step| step.last)
            .filter(|episode| self.learns_from(episode))
            .collect();
        if episodes.is_empty() {
            return None;
        }
        self.s.fill(0.0);
        for (mut column, step) in self.s.column_iter_mut().zip(episodes.iter().copied().flatten()) {
            column.copy_from_slice(step.s);
        }
        self.policy.forward(&self.s);
        if let Some(baseline) = &mut self.baseline {
            baseline.forward(&self.s);
        }
        let (mut column, mut losses) = (0, Losses::default());
        for episode in &episodes {
            let share = 1.0 / (episode.len() * episodes.len()) as f32;
            let returns = returns(episode);
            let (mean, std) = mean_and_population_std(&returns);
            let mut gamma_t = 1.0;
            for (step, g) in episode.iter().zip(&returns) {
                let weight = match (self.settings.weight, &mut self.baseline) {
                    (ReturnWeighting::Normalised, _) => (g - mean) / (std + STD_FLOOR),
                    (_, Some(baseline)) => {
                        // The gradient of ½ δ² (equation 3.22).
                        let delta = g - baseline.pass.output[column];
                        baseline.d[column] = -share * delta;
                        losses.critic_loss += share * delta * delta;
                        delta
                    }
                    (_, None) => *g,
                };
                let logits = self.policy.pass.output.column(column);
                let mut d = self.policy.d.column_mut(column);
                let action = (step.a[0] as usize).min(logits.len() - 1);
                let scale = share * gamma_t * weight;
                let ln_pi = policy_gradient(logits.as_slice(), action, scale, d.as_mut_slice());
                losses.actor_loss -= scale * ln_pi;
                losses.q_mean += share * g;
                if self.settings.discount_steps {
                    gamma_t *= step.discount;
                }
                column += 1;
            }
        }
        self.steps[0] += 1.0;
        let t = self.steps[0] as u64;
        self.policy.step(t, column, &self.s);
        if let Some(baseline) = &mut self.baseline {
            baseline.step(t, column, &self.s);
        }
        Some(losses)
    }

    /// Whether an episode is over and, unless `learn_at_limit` is set, was not ended by the time limit.
    fn learns_from(&self, episode: &[Transition<'_>]) -> bool {
        let is_finite = |step: &Transition<'_>| are_finite(step.s) && are_finite(step.s_next) && step.r.is_finite();
        episode
            .last()
            .is_some_and(|end| end.last && (self.settings.learn_at_limit || end.discount == 0.0))
            // Earlier versions did not check their rows.
            && episode.iter().all(is_finite)
    }

    fn networks(&self) -> impl Iterator<Item = &NetworkWithPass> {
        std::iter::once(&self.policy).chain(&self.baseline)
    }
}

/// Line 5: G of each step, computed backwards. The state after the last step adds no value, whether the episode was
/// terminated or truncated.
fn returns(episode: &[Transition<'_>]) -> Vec<f32> {
    let mut returns: Vec<f32> = episode
        .iter()
        .rev()
        .scan(0.0, |g, step| {
            *g = step.r + if step.last { 0.0 } else { step.discount * *g };
            Some(*g)
        })
        .collect();
    returns.reverse();
    returns
}

/// Mean and standard deviation of the numbers (divided by n, not by n − 1).
fn mean_and_population_std(numbers: &[f32]) -> (f32, f32) {
    let n = numbers.len() as f32;
    let mean = numbers.iter().sum::<f32>() / n;
    let squares: f32 = numbers.iter().map(|number| (number - mean).powi(2)).sum();
    (mean, (squares / n).sqrt())
}

/// Writes the gradient of −scale · ln π(a|s) into `d`: scale · (π(·|s) − 1[· = a]). Returns ln π(a|s).
fn policy_gradient(logits: &[f32], action: usize, scale: f32, d: &mut [f32]) -> f32 {
    let ln_normaliser = ln_sum_exp(logits);
    for (k, (d, logit)) in d.iter_mut().zip(logits).enumerate() {
        *d = scale * ((logit - ln_normaliser).exp() - f32::from(u8::from(k == action)));
    }
    logits[action] - ln_normaliser
}

fn ln_sum_exp(logits: &[f32]) -> f32 {
    let greatest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    greatest + logits.iter().map(|logit| (logit - greatest).exp()).sum::<f32>().ln()
}

impl AlgorithmDefinition for &config::ReinforceConfig {
    fn create(&self, config: &Config) -> Result<Box<dyn Algorithm>, PolicyError> {
        let (spec, seed) = (&config.spec, config.run.seed);
        Ok(Box::new(Reinforce::new(self, spec, seed, RunSizes::from(config))?))
    }

    fn weight_names(&self) -> &'static [&'static str] {
        &Reinforce::WEIGHTS
    }

    fn state_numbers(&self, spec: &EnvironmentSpec, _: RunSizes) -> usize {
        // Each network with its two moments, and the steps of Adam.
        3 * self.learned_shapes(spec).parameters() + 1
    }
}

impl Algorithm for Reinforce {
    fn policy(&self) -> Cow<'_, [f32]> {
        Cow::Borrowed(&self.policy.network.parameters)
    }

    fn layout(&self) -> PolicyLayout {
        PolicyLayout::Softmax(self.policy.network.layout)
    }

    fn updates(&self) -> u64 {
        self.rows
    }

    fn update(&mut self, replay: &Replay, rows: u64) -> Option<Losses> {
        let layout = replay.layout().row;
        let round: Vec<Transition<'_>> = (self.rows..rows).map(|row| layout.read(replay.row(row))).collect();
        self.rows = rows;
        self.learn(&round)
    }

    fn state(&self) -> Vec<StateArray<'_>> {
        let names = Self::WEIGHTS.into_iter().zip(Self::MOMENTS);
        let networks =
            self.networks()
                .zip(names)
                .flat_map(|(NetworkWithPass { network, .. }, (name, [first, second]))| {
                    [
                        (name, &*network.parameters),
                        (first, &*network.adam.first_moment),
                        (second, &*network.adam.second_moment),
                    ]
                });
        networks.chain([(Self::STEPS, self.steps.as_slice())]).collect()
    }

    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), StateArrayError> {
        let names = Self::WEIGHTS.into_iter().zip(Self::MOMENTS);
        let networks = std::iter::once(&mut self.policy).chain(&mut self.baseline);
        for (NetworkWithPass { network, .. }, (name, [first, second])) in networks.zip(names) {
            for (numbers, name) in [
                (&mut network.parameters, name),
                (&mut network.adam.first_moment, first),
                (&mut network.adam.second_moment, second),
            ] {
                let kept = saved.take(name, numbers.len())?;
                numbers.copy_from_slice(&kept);
            }
        }
        self.steps = [saved.take(Self::STEPS, 1)?[0]];
        self.rows = updates;
        Ok(())
    }
}

#[cfg(test)]
mod tests;
