use rand::RngExt;
use shoal_common::network::Hidden;
use shoal_common::space::Space;
use shoal_common::transition::RowLayout;

use super::*;
use crate::algorithms::testing::{
    assert_is_gradient_of, assert_threads_do_not_change_the_bits, copy_state, minibatch, network, wide,
};

const BATCH: usize = 5;

fn row() -> RowLayout {
    RowLayout::new(3, 2)
}

fn spec() -> EnvironmentSpec {
    EnvironmentSpec {
        observation: Space::boxed(&[(-1.0, 1.0); 3]),
        action: Space::boxed(&[(-1.0, 3.0), (-2.0, 2.0)]),
        time_limit: 200,
        state_width: 0,
    }
}

fn settings(hidden: Hidden) -> config::Td3Config {
    config::Td3Config {
        hidden: hidden.layers,
        activation: hidden.activation,
        batch: BATCH,
        ..config::Td3Config::default()
    }
}

fn algorithm_of(hidden: Hidden, seed: u64) -> Td3 {
    let mut td3 = Td3::new(&spec(), &settings(hidden), seed).unwrap();
    let mut numbers = stream(seed, Purpose::Sampling, 0, 0);
    for (_, parameters) in td3.state_mut(0).into_iter().filter(|(name, _)| WEIGHTS.contains(name)) {
        parameters.iter_mut().for_each(|x| *x = numbers.random_range(-0.7..0.7));
    }
    td3
}

fn policy(td3: &Td3, phi: &[f64], s: &[f64]) -> Vec<f64> {
    let z = network(&td3.actor.online.layout, phi, s, &[]);
    z.into_iter().map(f64::tanh).collect()
}

fn value(td3: &Td3, theta: &[f64], s: &[f64], a: &[f64]) -> f64 {
    network(td3.critics.layout(), theta, s, a)[0]
}

#[test]
fn the_actors_gradient_is_that_of_its_loss() {
    for hidden in [Hidden::relu([9, 7]), Hidden::tanh([9]), Hidden::relu([8, 9, 7])] {
        for seed in 0..10 {
            let (mut td3, batch) = (algorithm_of(hidden, seed), minibatch(seed, row(), BATCH));
            let loss = td3.actor_gradient(&batch.s);
            let theta = wide(&td3.critics.critics[0].network.online.parameters);
            let by_definition = |phi: &[f64]| {
                let of_sample = |i: usize| {
                    let s = wide(batch.s.column(i).as_slice());
                    value(&td3, &theta, &s, &policy(&td3, phi, &s))
                };
                -(0..BATCH).map(of_sample).sum::<f64>() / BATCH as f64
            };
            let phi = &td3.actor.online.parameters;
            let expected = by_definition(&wide(phi));
            assert!((f64::from(loss) - expected).abs() < 1e-5 * (1.0 + expected.abs()));
            assert_is_gradient_of(by_definition, &td3.actor.online.gradient, phi, 1.0);
        }
    }
}

#[test]
fn the_target_is_the_smaller_value_of_a_clipped_noisy_action() {
    let (mut td3, batch) = (algorithm_of(Hidden::relu([9, 7]), 1), minibatch(1, row(), BATCH));
    // Beyond the clip, within it, and none.
    let noise = DMatrix::from_fn(2, BATCH, |element, sample| {
        [9.0, -9.0, 1.0, -0.5, 0.0][sample] * (1.0 + element as f32)
    });
    let [first, second] = [0, 1].map(|critic| {
        let network = &td3.critics.critics[critic].network;
        (wide(&network.online.parameters), wide(&network.target))
    });
    let phi = wide(&td3.actor.target);
    let squares = (0..BATCH).map(|i| {
        let [s, a, s_next] = [&batch.s, &batch.a, &batch.s_next].map(|m| wide(m.column(i).as_slice()));
        let a_next: Vec<f64> = policy(&td3, &phi, &s_next)
            .into_iter()
            .enumerate()
            .map(|(element, a)| {
                let epsilon = (0.2 * f64::from(noise[(element, i)])).clamp(-0.5, 0.5);
                (a + epsilon).clamp(-1.0, 1.0)
            })
            .collect();
        let least = value(&td3, &first.1, &s_next, &a_next).min(value(&td3, &second.1, &s_next, &a_next));
        let y = f64::from(batch.r[i]) + f64::from(batch.discount[i]) * least;
        let a = [(a[0] - 1.0) / 2.0, a[1] / 2.0];
        [&first.0, &second.0]
            .map(|theta| (y - value(&td3, theta, &s, &a)).powi(2))
            .iter()
            .sum::<f64>()
    });
    let expected = squares.sum::<f64>() / BATCH as f64;
    let found = f64::from(td3.update(&batch, &noise).critic_loss);
    assert!((found - expected).abs() < 1e-5 * expected, "{found} for {expected}");
}

#[test]
fn policy_and_targets_move_at_every_second_update() {
    let mut td3 = algorithm_of(Hidden::relu([9, 7]), 1);
    let moved = |td3: &mut Td3, seed| {
        let before = td3.clone();
        td3.gradient_step(&minibatch(seed, row(), BATCH));
        let (before, after) = (before.state(), td3.state());
        let changed = before
            .iter()
            .zip(&after)
            .filter(|((name, before), (_, after))| WEIGHTS.contains(name) && before != after);
        changed.map(|((name, _), _)| *name).collect::<Vec<_>>()
    };
    assert_eq!(moved(&mut td3, 1), ["critic 1", "critic 2"]);
    assert_eq!(moved(&mut td3, 2), WEIGHTS);
    assert_eq!(moved(&mut td3, 3), ["critic 1", "critic 2"]);
}

#[test]
fn a_restored_algorithm_continues_with_the_same_bits() {
    let mut td3 = algorithm_of(Hidden::relu([9, 7]), 1);
    (0..3).for_each(|seed| {
        td3.gradient_step(&minibatch(seed, row(), BATCH));
    });
    let mut restored = Td3::new(&spec(), &settings(Hidden::relu([9, 7])), 1).unwrap();
    copy_state(&td3, &mut restored);
    for algorithm in [&mut td3, &mut restored] {
        algorithm.gradient_step(&minibatch(7, row(), BATCH));
    }
    assert_eq!(restored.state(), td3.state());
}

#[test]
fn two_threads_compute_the_same_bits_as_one() {
    for (hidden, size) in [
        (Hidden::relu([256, 256]), 256),
        (Hidden::relu([131, 267]), 33),
        (Hidden::relu([9, 7]), BATCH),
        (Hidden::tanh([400]), 64),
        (Hidden::relu([200, 150, 130]), 64),
    ] {
        let new = || {
            let settings = config::Td3Config {
                batch: size,
                ..settings(hidden)
            };
            Td3::new(&spec(), &settings, 1).unwrap()
        };
        assert_threads_do_not_change_the_bits(new, row(), size, &format!("{hidden:?}, batch {size}"));
    }
}
