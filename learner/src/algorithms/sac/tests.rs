use rand::RngExt;
use shoal_common::network::{GaussianPolicy, Hidden};
use shoal_common::space::Space;
use shoal_common::transition::RowLayout;

use super::*;
use crate::algorithms::testing::{
    assert_is_gradient_of, assert_threads_do_not_change_the_bits, copy_state, minibatch, network, wide,
};

const BATCH: usize = 5;
const ROW: (usize, usize) = (3, 2);
const ALPHA: f64 = 0.3;

fn row() -> RowLayout {
    RowLayout::new(ROW.0, ROW.1)
}

fn spec() -> EnvironmentSpec {
    EnvironmentSpec {
        observation: Space::boxed(&[(-1.0, 1.0); ROW.0]),
        action: Space::boxed(&[(-1.0, 3.0), (-2.0, 2.0)]),
        time_limit: 200,
        state_width: 0,
    }
}

fn settings(hidden: Hidden) -> config::SacConfig {
    config::SacConfig {
        hidden: hidden.layers,
        activation: hidden.activation,
        batch: BATCH,
        ..config::SacConfig::default()
    }
}

fn algorithm_of(hidden: Hidden, seed: u64) -> Sac {
    let mut sac = Sac::new(&spec(), &settings(hidden), seed).unwrap();
    let mut numbers = stream(seed, Purpose::Sampling, 0, 0);
    let [first, second] = &mut sac.critics.critics;
    let critics = [first, second].map(|critic| &mut *critic.network.online.parameters);
    for parameters in [&mut *sac.actor.parameters].into_iter().chain(critics) {
        parameters.iter_mut().for_each(|x| *x = numbers.random_range(-0.7..0.7));
    }
    for noise in [&mut sac.now.noise, &mut sac.next.noise] {
        noise.iter_mut().for_each(|x| *x = numbers.sample(StandardNormal));
    }
    sac
}

fn lists() -> [Hidden; 3] {
    [Hidden::relu([9, 7]), Hidden::tanh([9]), Hidden::relu([8, 9, 7])]
}

/// The actor's loss by the definition, in `f64`. The density of tanh u is the density of u divided by the slope of
/// tanh.
fn actor_loss(sac: &Sac, phi: &[f64], batch: &Minibatch) -> f64 {
    let of_sample = |i: usize| {
        let s = wide(batch.s.column(i).as_slice());
        let outputs = network(&sac.actor.layout, phi, &s, &[]);
        let (mu, log_sigma) = outputs.split_at(ROW.1);
        let (mut a, mut log_pi) = (Vec::new(), 0.0);
        for (k, (mu, log_sigma)) in mu.iter().zip(log_sigma).enumerate() {
            let epsilon = f64::from(sac.now.noise[(k, i)]);
            let sigma = log_sigma.clamp(-20.0, 2.0).exp();
            let u = mu + sigma * epsilon;
            let density = (-0.5 * epsilon * epsilon).exp() / (sigma * (2.0 * std::f64::consts::PI).sqrt());
            // 1 − tanh² u = 1 / cosh² u.
            log_pi += density.ln() + 2.0 * u.cosh().ln();
            a.push(u.tanh());
        }
        let value = |critic: usize| {
            let online = &sac.critics.critics[critic].network.online;
            network(&online.layout, &wide(&online.parameters), &s, &a)[0]
        };
        ALPHA * log_pi - value(0).min(value(1))
    };
    (0..BATCH).map(of_sample).sum::<f64>() / BATCH as f64
}

#[test]
fn the_actors_gradient_is_that_of_its_loss() {
    for hidden in lists() {
        let shares: Vec<f64> = (0..10)
            .map(|seed| {
                let (mut sac, batch) = (algorithm_of(hidden, seed), minibatch(seed, row(), BATCH));
                sac.draw(&batch);
                let loss = sac.actor_gradient(&batch.s, ALPHA as f32);
                let phi = &sac.actor.parameters;
                let expected = actor_loss(&sac, &wide(phi), &batch);
                assert!((f64::from(loss) - expected).abs() < 1e-5 * (1.0 + expected.abs()));
                assert_is_gradient_of(|phi| actor_loss(&sac, phi, &batch), &sac.actor.gradient, phi, 10.0)
            })
            .collect();
        assert!(
            shares.iter().sum::<f64>() > 4.0,
            "{hidden:?}: {shares:?} of the gradient"
        );
    }
}

#[test]
fn a_clamped_standard_deviation_gets_no_gradient() {
    let mut sac = algorithm_of(Hidden::relu([9, 7]), 1);
    // The biases of both ln σ.
    let end = sac.actor.parameters.len();
    sac.actor.parameters[end - 2..].copy_from_slice(&[50.0, -50.0]);
    let batch = minibatch(1, row(), BATCH);
    sac.draw(&batch);
    sac.actor_gradient(&batch.s, ALPHA as f32);
    assert_eq!(sac.actor.gradient[end - 2..], [0.0, 0.0]);
    assert!(sac.now.log_pi.iter().all(|log_pi| log_pi.is_finite()));
}

#[test]
fn the_density_is_finite_for_actions_at_the_bounds() {
    for u in [-60.0, -9.0, 9.0, 60.0_f32] {
        let found = f64::from(log_density(u, 0.5, -1.0));
        // ln(1 − tanh² u) = 2 ln 2 − 2 |u| where the exponential vanishes.
        let normal = -0.125 + 1.0 - 0.5 * (2.0 * std::f64::consts::PI).ln();
        let expected = normal - (2.0 * std::f64::consts::LN_2 - 2.0 * f64::from(u.abs()));
        assert!(
            (found - expected).abs() < 1e-5 * expected.abs(),
            "{found} for {expected}"
        );
    }
}

#[test]
fn the_temperature_moves_towards_the_target_entropy() {
    let temperature = |log_pi: f32| {
        let mut sac = algorithm_of(Hidden::relu([9, 7]), 1);
        let before = sac.temperature();
        sac.temperature.step(1, &DVector::from_element(BATCH, log_pi));
        sac.temperature() - before
    };
    // The target entropy is −2: at ln π = 2 the entropy is that, below it is higher.
    assert_eq!(temperature(2.0), 0.0);
    assert!(temperature(1.0) < 0.0 && temperature(3.0) > 0.0);
}

#[test]
fn the_value_of_s_next_includes_the_entropy_and_that_of_a_terminal_state_is_not_used() {
    let (mut one, mut other) = (
        algorithm_of(Hidden::relu([9, 7]), 1),
        algorithm_of(Hidden::relu([9, 7]), 1),
    );
    let (batch, mut changed) = (minibatch(1, row(), BATCH), minibatch(1, row(), BATCH));
    assert_eq!(batch.discount[2], 0.0);
    changed.s_next.column_mut(2).fill(f32::NAN);
    assert_eq!(one.gradient_step(&batch), other.gradient_step(&changed));
    assert_eq!(one.state(), other.state());
    one.temperature.log_alpha = [-3.0];
    assert_ne!(
        one.gradient_step(&batch).critic_loss,
        other.gradient_step(&batch).critic_loss
    );
}

#[test]
fn a_restored_algorithm_continues_with_the_same_bits() {
    let mut sac = algorithm_of(Hidden::relu([9, 7]), 1);
    (0..3).for_each(|seed| {
        sac.gradient_step(&minibatch(seed, row(), BATCH));
    });
    let mut restored = Sac::new(&spec(), &settings(Hidden::relu([9, 7])), 1).unwrap();
    copy_state(&sac, &mut restored);
    for algorithm in [&mut sac, &mut restored] {
        algorithm.gradient_step(&minibatch(7, row(), BATCH));
    }
    assert_eq!(restored.state(), sac.state());
    assert!(sac.temperature() != 1.0 && sac.temperature().is_finite());
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
            let settings = config::SacConfig {
                batch: size,
                ..settings(hidden)
            };
            Sac::new(&spec(), &settings, 1).unwrap()
        };
        assert_threads_do_not_change_the_bits(new, row(), size, &format!("{hidden:?}, batch {size}"));
    }
}

#[test]
fn actors_compute_the_same_bits_as_the_learner() {
    for hidden in lists() {
        let (mut sac, batch) = (algorithm_of(hidden, 1), minibatch(1, row(), BATCH));
        sac.draw(&batch);
        let mut policy = GaussianPolicy::new(sac.actor.layout, sac.range.clone(), BATCH);
        let mut actions = vec![0.0; ROW.1 * BATCH];
        let mut noise = sac.now.noise.iter().copied();
        policy.sample(sac.policy(), batch.s.as_slice(), || noise.next().unwrap(), &mut actions);
        let expected: Vec<f32> = (0..actions.len())
            .map(|at| sac.range.action(at % ROW.1, sac.now.a[at]))
            .collect();
        assert_eq!(actions, expected, "{hidden:?}");
    }
}
