use rand::RngExt;
use shoal_common::space::Space;
use shoal_common::stream::{Purpose, stream};
use shoal_common::transition::RowLayout;

use super::*;
use crate::algorithms::testing::{
    self, assert_is_gradient_of, assert_threads_do_not_change_the_bits, copy_state, network, wide,
};

const BATCH: usize = 5;
const ACTIONS: usize = 3;

fn spec() -> EnvironmentSpec {
    EnvironmentSpec {
        observation: Space::boxed(&[(-1.0, 1.0); 3]),
        action: Space::discrete(ACTIONS as u32),
        time_limit: 200,
        state_width: 0,
    }
}

fn settings(double: bool, dueling: bool) -> config::DqnConfig {
    config::DqnConfig {
        hidden: [9, 7].into(),
        batch: BATCH,
        target_every: 3,
        double,
        dueling,
        ..config::DqnConfig::default()
    }
}

fn algorithm_of(settings: &config::DqnConfig, seed: u64) -> Dqn {
    let mut dqn = Dqn::new(&spec(), settings, seed).unwrap();
    let mut numbers = stream(seed, Purpose::Sampling, 0, 0);
    for (_, parameters) in dqn.state_mut(0).into_iter().take(2) {
        parameters.iter_mut().for_each(|x| *x = numbers.random_range(-0.9..0.9));
    }
    dqn
}

fn minibatch(seed: u64, size: usize) -> Minibatch {
    let mut batch = testing::minibatch(seed, RowLayout::new(3, 1), size);
    batch
        .a
        .iter_mut()
        .enumerate()
        .for_each(|(i, a)| *a = (i % ACTIONS) as f32);
    // Some errors are beyond δ.
    batch.r.iter_mut().step_by(2).for_each(|r| *r *= 4.0);
    batch
}

/// Q(s, ·) by the definition.
fn values(dqn: &Dqn, theta: &[f64], s: &[f64]) -> Vec<f64> {
    let outputs = network(&dqn.network.online.layout, theta, s, &[]);
    if !dqn.settings.dueling {
        return outputs;
    }
    let (value, advantages) = (outputs[0], &outputs[1..]);
    let mean = advantages.iter().sum::<f64>() / advantages.len() as f64;
    advantages.iter().map(|advantage| value + advantage - mean).collect()
}

fn best(values: &[f64]) -> usize {
    (0..values.len()).fold(0, |best, i| if values[i] > values[best] { i } else { best })
}

fn loss(dqn: &Dqn, theta: &[f64], batch: &Minibatch) -> f64 {
    let (online, target) = (wide(&dqn.network.online.parameters), wide(&dqn.network.target));
    let of_sample = |i: usize| {
        let [s, s_next] = [&batch.s, &batch.s_next].map(|m| wide(m.column(i).as_slice()));
        let next = values(dqn, &target, &s_next);
        let chosen = if dqn.settings.double {
            best(&values(dqn, &online, &s_next))
        } else {
            best(&next)
        };
        let y = f64::from(batch.r[i]) + f64::from(batch.discount[i]) * next[chosen];
        let e = (values(dqn, theta, &s)[batch.a[i] as usize] - y).abs();
        if e <= 1.0 { 0.5 * e * e } else { e - 0.5 }
    };
    (0..BATCH).map(of_sample).sum::<f64>() / BATCH as f64
}

#[test]
fn the_gradient_is_that_of_hubers_loss() {
    for (double, dueling) in [(true, false), (false, false), (true, true), (false, true)] {
        for seed in 0..10 {
            let (mut dqn, batch) = (algorithm_of(&settings(double, dueling), seed), minibatch(seed, BATCH));
            dqn.evaluate(&batch);
            let (found, _) = dqn.gradient(&batch);
            let theta = &dqn.network.online.parameters;
            let expected = loss(&dqn, &wide(theta), &batch);
            assert!((f64::from(found) - expected).abs() < 1e-5 * (1.0 + expected));
            assert_is_gradient_of(
                |theta| loss(&dqn, theta, &batch),
                &dqn.network.online.gradient,
                theta,
                1.0,
            );
        }
    }
}

#[test]
fn the_target_network_is_copied_after_every_third_update() {
    let mut dqn = algorithm_of(&settings(true, false), 1);
    for t in 1..=7 {
        let before = dqn.network.target.clone();
        dqn.gradient_step(&minibatch(t, BATCH));
        if t.is_multiple_of(3) {
            assert_eq!(*dqn.network.target, *dqn.network.online.parameters, "update {t}");
        } else {
            assert_eq!(*dqn.network.target, *before, "update {t}");
        }
    }
}

#[test]
fn a_restored_algorithm_continues_with_the_same_bits() {
    let settings = settings(true, true);
    let mut dqn = algorithm_of(&settings, 1);
    (0..2).for_each(|seed| {
        dqn.gradient_step(&minibatch(seed, BATCH));
    });
    let mut restored = Dqn::new(&spec(), &settings, 99).unwrap();
    copy_state(&dqn, &mut restored);
    for algorithm in [&mut dqn, &mut restored] {
        algorithm.gradient_step(&minibatch(7, BATCH));
    }
    assert_eq!(restored.state(), dqn.state());
}

#[test]
fn two_threads_compute_the_same_bits_as_one() {
    for (hidden, size) in [([256, 256], 64), ([131, 267], 33), ([9, 7], BATCH)] {
        let new = || {
            let settings = config::DqnConfig {
                hidden: hidden.into(),
                batch: size,
                ..settings(true, true)
            };
            Dqn::new(&spec(), &settings, 1).unwrap()
        };
        let what = format!("{hidden:?}, batch {size}");
        assert_threads_do_not_change_the_bits(new, RowLayout::new(3, 1), size, &what);
    }
}
