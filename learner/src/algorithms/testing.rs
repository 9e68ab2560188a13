//! Support for tests of gradient steps: networks by their definition in `f64`, finite differences, minibatches.

use rand::RngExt;
use shoal_common::network::{Activation, Hidden, NetworkLayout};
use shoal_common::stream::{Purpose, Stream, stream};
use shoal_common::transition::{RowLayout, Transition};

use super::minibatch::Minibatch;
use super::minibatch_algorithm::MinibatchAlgorithm;
use crate::networks::digest::sha256;
use crate::networks::threads::Threads;

fn random(numbers: &mut Stream, count: usize) -> Vec<f32> {
    (0..count).map(|_| numbers.random_range(-2.0..2.0)).collect()
}

/// A minibatch of random transitions with different discounts; the third discount is 0.
pub(super) fn minibatch(seed: u64, row: RowLayout, size: usize) -> Minibatch {
    let mut numbers = stream(seed, Purpose::Environment, 0, 0);
    let mut batch = Minibatch::new(row, size);
    for column in 0..size {
        let [s, a, s_next] = [row.observation_width(), row.action_width(), row.observation_width()]
            .map(|count| random(&mut numbers, count));
        let (r, discount) = (numbers.random_range(-1.0..1.0), [0.99, 0.9, 0.0, 1.0, 0.97][column % 5]);
        batch.set(
            column,
            &Transition {
                s: &s,
                a: &a,
                r,
                discount,
                s_next: &s_next,
                last: false,
            },
        );
    }
    batch
}

/// A network's output for one sample by the definition, with parameters in `f64`.
pub(super) fn network(layout: &NetworkLayout, parameters: &[f64], x: &[f64], actions: &[f64]) -> Vec<f64> {
    let mut x = x.to_vec();
    let Hidden { layers, activation } = layout.hidden();
    for (number, range) in layout.layer_ranges().enumerate() {
        if Some(number) == layout.action_layer() {
            x.extend(actions);
        }
        let (w, b) = (&parameters[range.weights], &parameters[range.biases]);
        let z = |i: usize| b[i] + x.iter().enumerate().map(|(j, x)| w[j * b.len() + i] * x).sum::<f64>();
        x = (0..b.len())
            .map(|i| match activation {
                _ if number == layers.len() => z(i),
                Activation::Relu => z(i).max(0.0),
                Activation::Tanh => z(i).tanh(),
            })
            .collect();
    }
    x
}

pub(super) fn wide(numbers: &[f32]) -> Vec<f64> {
    numbers.iter().map(|&x| x.into()).collect()
}

/// Compares `gradient` with central differences of `loss`. They are in `f64`, so that the step can be small enough to
/// rarely cross a ReLU's corner. `scale` is the size of the numbers that the gradient is computed from, and so of its
/// rounding errors. Returns the share of the gradient that is not nearly zero.
pub(super) fn assert_is_gradient_of(
    loss: impl Fn(&[f64]) -> f64,
    gradient: &[f32],
    parameters: &[f32],
    scale: f64,
) -> f64 {
    const STEP: f64 = 1e-6;
    let mut theta = wide(parameters);
    for (i, &found) in gradient.iter().enumerate() {
        let middle = theta[i];
        let mut at = |x: f64| {
            theta[i] = x;
            loss(&theta)
        };
        let expected = (at(middle + STEP) - at(middle - STEP)) / (2.0 * STEP);
        theta[i] = middle;
        let tolerance = 2e-6 * scale + 2e-5 * expected.abs();
        assert!(
            (f64::from(found) - expected).abs() < tolerance,
            "parameter {i}: {found} for {expected}"
        );
    }
    gradient.iter().filter(|g| g.abs() > 1e-3).count() as f64 / gradient.len() as f64
}

/// Gives `to` the whole state of `from`.
pub(super) fn copy_state<A: MinibatchAlgorithm>(from: &A, to: &mut A) {
    let names: Vec<_> = from.state().iter().map(|(name, _)| *name).collect();
    let arrays = to.state_mut(from.updates());
    assert_eq!(arrays.iter().map(|(name, _)| *name).collect::<Vec<_>>(), names);
    for ((_, to), (_, from)) in arrays.into_iter().zip(from.state()) {
        to.copy_from_slice(from);
    }
}

/// Asserts that an algorithm, made by `new` each time, ends with the same numbers on two threads as on one.
pub(super) fn assert_threads_do_not_change_the_bits<A: MinibatchAlgorithm>(
    new: impl Fn() -> A + Sync,
    row: RowLayout,
    size: usize,
    what: &str,
) {
    let run = |threads: Threads| {
        let mut algorithm = new();
        algorithm.set_threads(threads);
        for seed in 0..6 {
            algorithm.gradient_step(&minibatch(seed, row, size));
        }
        let state = algorithm.state().into_iter();
        state
            .map(|(name, numbers)| (name, sha256(&[numbers])))
            .collect::<Vec<_>>()
    };
    // A thread can start a second one only once.
    let shared = std::thread::scope(|scope| scope.spawn(|| run(Threads::two_threads().unwrap())).join().unwrap());
    assert_eq!(shared, run(Threads::SINGLE), "{what}");
}
