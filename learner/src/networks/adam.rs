//! Adam (Kingma and Ba 2015) and the soft target update, in one sweep over the parameters.

use pulp::Arch;

use super::aligned::{Aligned, PAGE};
use super::threads::Threads;

const BETA_1: f64 = 0.9;
const BETA_2: f64 = 0.999;
const EPSILON: f32 = 1e-8;

/// Moments closer to zero than this become zero. Without a gradient they would decay to denormal numbers, and computing
/// with such numbers is a hundred times slower. The steps that are dropped are below 1e-18 / ε of the learning rate.
const FIRST_MOMENT_FLOOR: f32 = 1e-18;
/// As [`FIRST_MOMENT_FLOOR`], for squares. The root of this is negligible beside ε.
const SECOND_MOMENT_FLOOR: f32 = 1e-30;

/// Adam's state for a network: running means of its gradient and of the gradient's square.
#[derive(Clone, Debug)]
pub struct Adam {
    learning_rate: f64,
    pub(crate) first_moment: Aligned,
    pub(crate) second_moment: Aligned,
}

impl Adam {
    /// The state before the first step, for this number of parameters.
    pub fn new(learning_rate: f64, parameters: usize) -> Self {
        Self {
            learning_rate,
            first_moment: Aligned::zeros(parameters, 3),
            second_moment: Aligned::zeros(parameters, 4),
        }
    }

    /// Takes step number `t` (from 1) of `parameters` θ against `gradient`. Both have the length of the network's
    /// parameters. The threads share the work.
    ///
    /// Bias correction as in PyTorch: θ ← θ − α / (1 − β₁ᵗ) · m / (√v / √(1 − β₂ᵗ) + ε).
    pub fn step(&mut self, threads: &Threads, t: u64, gradient: &[f32], parameters: &mut [f32]) {
        let correction = self.bias_correction(t);
        let cut = cut(threads, parameters.len());
        let part = |gradient: &[f32], m: &mut [f32], v: &mut [f32], parameters: &mut [f32]| {
            let moments = m.iter_mut().zip(v);
            Arch::new().dispatch(|| {
                for ((g, (m, v)), weight) in gradient.iter().zip(moments).zip(parameters) {
                    *weight -= correction.step(*g, m, v);
                }
            });
        };
        let gradient = gradient.split_at(cut);
        let m = self.first_moment.split_at_mut(cut);
        let v = self.second_moment.split_at_mut(cut);
        let parameters = parameters.split_at_mut(cut);
        threads.both(
            || part(gradient.0, m.0, v.0, parameters.0),
            || part(gradient.1, m.1, v.1, parameters.1),
        );
    }

    /// As [`step`](Self::step); then `target` ← τ θ + (1 − τ) `target` (equation 3.31), in the same sweep.
    pub fn step_with_target(
        &mut self,
        threads: &Threads,
        t: u64,
        gradient: &[f32],
        parameters: &mut [f32],
        tau: f32,
        target: &mut [f32],
    ) {
        let correction = self.bias_correction(t);
        let cut = cut(threads, parameters.len());
        let part = |gradient: &[f32], m: &mut [f32], v: &mut [f32], parameters: &mut [f32], target: &mut [f32]| {
            let moments = m.iter_mut().zip(v);
            let weights = parameters.iter_mut().zip(target);
            Arch::new().dispatch(|| {
                for ((g, (m, v)), (weight, target)) in gradient.iter().zip(moments).zip(weights) {
                    *weight -= correction.step(*g, m, v);
                    *target += tau * (*weight - *target);
                }
            });
        };
        let gradient = gradient.split_at(cut);
        let m = self.first_moment.split_at_mut(cut);
        let v = self.second_moment.split_at_mut(cut);
        let parameters = parameters.split_at_mut(cut);
        let target = target.split_at_mut(cut);
        threads.both(
            || part(gradient.0, m.0, v.0, parameters.0, target.0),
            || part(gradient.1, m.1, v.1, parameters.1, target.1),
        );
    }

    fn bias_correction(&self, t: u64) -> BiasCorrection {
        BiasCorrection {
            step_size: (self.learning_rate / (1.0 - BETA_1.powf(t as f64))) as f32,
            second_moment: (1.0 / (1.0 - BETA_2.powf(t as f64)).sqrt()) as f32,
        }
    }
}

/// How many of the parameters the first thread takes: whole pages.
fn cut(threads: &Threads, parameters: usize) -> usize {
    (threads.first_share(parameters.div_ceil(PAGE)) * PAGE).min(parameters)
}

/// The bias correction of learning rate and moments, which depends on a step's number.
#[derive(Clone, Copy)]
struct BiasCorrection {
    step_size: f32,
    second_moment: f32,
}

impl BiasCorrection {
    /// Updates the moments of a parameter with its gradient `g`. Returns how far the parameter moves against `g`.
    #[inline(always)]
    fn step(self, g: f32, m: &mut f32, v: &mut f32) -> f32 {
        let (fresh_1, fresh_2) = ((1.0 - BETA_1) as f32, (1.0 - BETA_2) as f32);
        // A gradient below the floor cannot raise either moment above its floor, and its square would be denormal.
        let g = floored(g, FIRST_MOMENT_FLOOR);
        *m = floored(*m + fresh_1 * (g - *m), FIRST_MOMENT_FLOOR);
        *v = floored(*v + fresh_2 * (g * g - *v), SECOND_MOMENT_FLOOR);
        self.step_size * *m / (v.sqrt() * self.second_moment + EPSILON)
    }
}

/// `x`, or 0 if it is closer to zero than `floor`.
#[inline(always)]
fn floored(x: f32, floor: f32) -> f32 {
    if x.abs() < floor { 0.0 } else { x }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The algorithm of the paper for one number, in `f64`.
    #[derive(Default)]
    struct Reference {
        m: f64,
        v: f64,
        t: i32,
    }

    impl Reference {
        fn step(&mut self, learning_rate: f64, g: f64, weight: f64) -> f64 {
            self.t += 1;
            self.m = 0.9 * self.m + 0.1 * g;
            self.v = 0.999 * self.v + 0.001 * g * g;
            let m_hat = self.m / (1.0 - 0.9f64.powi(self.t));
            let v_hat = self.v / (1.0 - 0.999f64.powi(self.t));
            weight - learning_rate * m_hat / (v_hat.sqrt() + 1e-8)
        }
    }

    #[test]
    fn adam_follows_the_paper_for_a_thousand_steps() {
        let count = 37;
        let mut adam = Adam::new(1e-3, count);
        let (mut weights, mut targets) = (vec![0.5f32; count], vec![-0.5f32; count]);
        let mut references: Vec<Reference> = (0..count).map(|_| Reference::default()).collect();
        let (mut expected, mut expected_targets) = (vec![0.5f64; count], vec![-0.5f64; count]);
        for t in 1..=1000u64 {
            let gradient: Vec<f32> = (0..count)
                .map(|i| ((t as f32 * 0.37 + i as f32).sin() + 0.2) * 10f32.powi(i as i32 % 9 - 6))
                .collect();
            adam.step_with_target(&Threads::SINGLE, t, &gradient, &mut weights, 0.01, &mut targets);
            for i in 0..count {
                expected[i] = references[i].step(1e-3, gradient[i].into(), expected[i]);
                expected_targets[i] = 0.01 * expected[i] + 0.99 * expected_targets[i];
                assert!(
                    (f64::from(weights[i]) - expected[i]).abs() < 1e-5,
                    "step {t}, weight {i}"
                );
                assert!(
                    (f64::from(targets[i]) - expected_targets[i]).abs() < 1e-5,
                    "step {t}, target {i}"
                );
            }
        }
    }

    #[test]
    fn a_step_without_a_target_is_the_step_with_one() {
        let (mut without, mut with) = (Adam::new(1e-2, 3), Adam::new(1e-2, 3));
        let (mut weights, mut same, mut target) = ([0.5_f32; 3], [0.5_f32; 3], [0.0_f32; 3]);
        for t in 1..=20 {
            let gradient = [0.3, -0.1 * t as f32, 0.0];
            without.step(&Threads::SINGLE, t, &gradient, &mut weights);
            with.step_with_target(&Threads::SINGLE, t, &gradient, &mut same, 0.1, &mut target);
        }
        assert_eq!(weights, same);
        assert_ne!(weights[..2], [0.5; 2]);
    }

    #[test]
    fn moments_without_gradient_end_at_zero_and_are_never_denormal() {
        let mut adam = Adam::new(1e-3, 20);
        let (mut weights, mut targets) = (vec![0.0; 20], vec![0.0; 20]);
        adam.step_with_target(&Threads::SINGLE, 1, &[1e-9; 20], &mut weights, 0.01, &mut targets);
        for t in 2..=30_000 {
            adam.step_with_target(
                &Threads::SINGLE,
                t,
                &[if t < 500 { 1e-22 } else { 0.0 }; 20],
                &mut weights,
                0.01,
                &mut targets,
            );
            for moment in adam.first_moment.iter().chain(&*adam.second_moment) {
                assert!(!moment.is_subnormal(), "step {t}: {moment:e}");
            }
        }
        assert_eq!(*adam.first_moment, [0.0; 20]);
        assert_eq!(*adam.second_moment, [0.0; 20]);
    }
}
