use rand::RngExt;
use shoal_common::network::{DeterministicPolicy, Hidden, Layers};
use shoal_common::space::Space;
use shoal_common::stream::{Purpose, stream};
use shoal_common::transition::RowLayout;

use super::*;
use crate::algorithms::testing::{self, assert_is_gradient_of, network, wide};

const BATCH: usize = 5;

fn spec() -> EnvironmentSpec {
    EnvironmentSpec {
        observation: Space::boxed(&[(-1.0, 1.0); 3]),
        action: Space::boxed(&[(-1.0, 3.0), (-2.0, 2.0)]),
        time_limit: 200,
        state_width: 0,
    }
}

fn settings() -> config::DdpgConfig {
    config::DdpgConfig {
        tau: 0.01,
        actor_learning_rate: 1e-3,
        critic_learning_rate: 1e-2,
        hidden: [9, 7].into(),
        batch: BATCH,
        ..config::DdpgConfig::default()
    }
}

/// Lists of hidden layers of every kind: the shortest, two layers as in the thesis, three, and the longest.
fn lists() -> Vec<Hidden> {
    let lists: [Layers; 4] = [
        [9].into(),
        [9, 7].into(),
        [8, 9, 7].into(),
        [6, 5, 7, 6, 5, 6, 7, 5].into(),
    ];
    let both = lists.map(|layers| [Hidden::relu(layers), Hidden::tanh(layers)]);
    both.concat()
}

fn algorithm(seed: u64) -> Ddpg {
    algorithm_of(Hidden::relu([9, 7]), seed)
}

/// An algorithm whose output layers are as large as the others, so that every gradient is well above rounding errors.
fn algorithm_of(hidden: Hidden, seed: u64) -> Ddpg {
    let settings = config::DdpgConfig {
        hidden: hidden.layers,
        activation: hidden.activation,
        ..settings()
    };
    let mut ddpg = Ddpg::new(&spec(), &settings, seed).unwrap();
    // Numbers shrink through many layers.
    let bound = if hidden.layers.len() > 3 { 1.2 } else { 0.7 };
    let mut numbers = stream(seed, Purpose::Sampling, 0, 0);
    for network in [&mut ddpg.actor, &mut ddpg.critic] {
        network
            .online
            .parameters
            .iter_mut()
            .for_each(|x| *x = numbers.random_range(-bound..bound));
        network
            .target
            .iter_mut()
            .for_each(|x| *x = numbers.random_range(-bound..bound));
    }
    ddpg
}

fn minibatch(seed: u64) -> Minibatch {
    testing::minibatch(seed, RowLayout::new(3, 2), BATCH)
}

fn policy(ddpg: &Ddpg, parameters: &[f64], s: &[f64]) -> Vec<f64> {
    let z = network(ddpg.layouts().0, parameters, s, &[]);
    let [centre, half] = [[1.0, 0.0], [2.0, 2.0]];
    z.iter()
        .enumerate()
        .map(|(i, z)| centre[i] + half[i] * z.tanh())
        .collect()
}

fn critic_loss(ddpg: &Ddpg, theta: &[f64], batch: &Minibatch) -> f64 {
    let [target_actor, target_critic] = [wide(&ddpg.actor.target), wide(&ddpg.critic.target)];
    let square = |i: usize| {
        let [s, a, s_next] = [&batch.s, &batch.a, &batch.s_next].map(|m| wide(m.column(i).as_slice()));
        let a_next = policy(ddpg, &target_actor, &s_next);
        let q_next = network(ddpg.layouts().1, &target_critic, &s_next, &a_next)[0];
        let y = f64::from(batch.r[i]) + f64::from(batch.discount[i]) * q_next;
        (y - network(ddpg.layouts().1, theta, &s, &a)[0]).powi(2)
    };
    (0..BATCH).map(square).sum::<f64>() / BATCH as f64
}

fn actor_loss(ddpg: &Ddpg, theta: &[f64], batch: &Minibatch) -> f64 {
    let critic = wide(&ddpg.critic.online.parameters);
    let value = |i: usize| {
        let s = wide(batch.s.column(i).as_slice());
        network(ddpg.layouts().1, &critic, &s, &policy(ddpg, theta, &s))[0]
    };
    -(0..BATCH).map(value).sum::<f64>() / BATCH as f64
}

/// Asserts that enough of the gradient was not nearly zero. With many ReLU layers, some samples do not affect the
/// output.
fn assert_enough(hidden: Hidden, shares: &[f64]) {
    let mean = shares.iter().sum::<f64>() / shares.len() as f64;
    let least = if hidden.layers.len() > 3 { 0.2 } else { 0.4 };
    assert!(mean > least, "{hidden:?}: {mean} of the gradient");
}

#[test]
fn the_critics_gradient_is_that_of_its_loss() {
    for hidden in lists() {
        let shares = (0..10).map(|seed| {
            let (mut ddpg, batch) = (algorithm_of(hidden, seed), minibatch(seed));
            ddpg.evaluate(&batch);
            let (loss, _) = ddpg.critic_gradient(&batch);
            let theta = &ddpg.critic.online.parameters;
            let expected = critic_loss(&ddpg, &wide(theta), &batch);
            assert!((f64::from(loss) - expected).abs() < 1e-5 * (1.0 + expected));
            assert_is_gradient_of(
                |theta| critic_loss(&ddpg, theta, &batch),
                &ddpg.critic.online.gradient,
                theta,
                1.0,
            )
        });
        assert_enough(hidden, &shares.collect::<Vec<_>>());
    }
}

#[test]
fn the_actors_gradient_is_that_of_its_loss() {
    for hidden in lists() {
        let shares = (0..10).map(|seed| {
            let (mut ddpg, batch) = (algorithm_of(hidden, seed), minibatch(seed));
            ddpg.evaluate(&batch);
            let loss = ddpg.actor_gradient(&batch.s);
            let theta = &ddpg.actor.online.parameters;
            let expected = actor_loss(&ddpg, &wide(theta), &batch);
            assert!((f64::from(loss) - expected).abs() < 1e-5 * (1.0 + expected.abs()));
            assert_is_gradient_of(
                |theta| actor_loss(&ddpg, theta, &batch),
                &ddpg.actor.online.gradient,
                theta,
                1.0,
            )
        });
        assert_enough(hidden, &shares.collect::<Vec<_>>());
    }
}

#[test]
fn the_value_of_a_terminal_state_is_not_used() {
    let (mut one, mut other) = (algorithm(1), algorithm(1));
    let (batch, mut changed) = (minibatch(1), minibatch(1));
    assert_eq!(batch.discount[2], 0.0);
    changed.s_next.column_mut(2).fill(f32::NAN);
    assert_eq!(one.update(&batch), other.update(&changed));
    assert_eq!(one.digest(), other.digest());
    changed.s_next.column_mut(1).fill(0.5);
    one.update(&batch);
    other.update(&changed);
    assert_ne!(
        one.digest(),
        other.digest(),
        "the state after a step that did not terminate counts"
    );
}

#[test]
fn the_same_seed_gives_the_same_bits() {
    let run = |seed| {
        let mut ddpg = Ddpg::new(&spec(), &settings(), seed).unwrap();
        for t in 0..20 {
            ddpg.update(&minibatch(t));
        }
        ddpg.digest()
    };
    assert_eq!(run(1), run(1));
    assert_ne!(run(1), run(2));
}

/// The sizes include odd ones, whose products are split within a kernel's blocks, and small ones, which are not split.
#[test]
fn two_threads_compute_the_same_bits_as_one() {
    for (hidden, size) in [
        (Hidden::relu([400, 300]), 64),
        (Hidden::relu([131, 267]), 33),
        (Hidden::relu([4, 2_049]), 4),
        (Hidden::relu([5, 8_192]), 2),
        (Hidden::relu([2, 300]), 64),
        (Hidden::relu([9, 7]), BATCH),
        (Hidden::tanh([400, 300]), 64),
        (Hidden::relu([400]), 64),
        (Hidden::relu([131]), 67),
        (Hidden::tanh([2_049]), 4),
        (Hidden::relu([128]), 64),
        (Hidden::relu([200, 150, 130]), 64),
        (Hidden::tanh([131, 267, 249]), 33),
        (Hidden::relu([4, 4, 300]), 2_100),
        (Hidden::relu([5, 2_049, 2_051]), 4),
        (Hidden::relu([3, 300, 300]), 64),
        (Hidden::tanh([64, 128, 129, 130, 131, 132, 133, 134]), 65),
    ] {
        let settings = config::DdpgConfig {
            hidden: hidden.layers,
            activation: hidden.activation,
            batch: size,
            ..settings()
        };
        let run = |threads: Threads| {
            let mut ddpg = Ddpg::new(&spec(), &settings, 1).unwrap();
            ddpg.set_threads(threads);
            let mut batch = Minibatch::new(RowLayout::new(3, 2), size);
            for t in 0..10 {
                let mut numbers = stream(t, Purpose::Environment, 0, 0);
                for matrix in [&mut batch.s, &mut batch.a, &mut batch.s_next] {
                    matrix.iter_mut().for_each(|x| *x = numbers.random_range(-2.0..2.0));
                }
                batch.r.iter_mut().for_each(|x| *x = numbers.random_range(-1.0..1.0));
                batch.discount.fill(0.99);
                ddpg.update(&batch);
            }
            ddpg.digest()
        };
        // A thread can start a second one only once.
        let shared = std::thread::scope(|scope| scope.spawn(|| run(Threads::two_threads().unwrap())).join().unwrap());
        assert_eq!(shared, run(Threads::SINGLE), "{hidden:?}, batch {size}");
    }
}

#[test]
fn targets_start_as_copies_and_follow_their_networks() {
    let mut ddpg = Ddpg::new(&spec(), &settings(), 1).unwrap();
    assert_eq!(*ddpg.actor.online.parameters, *ddpg.actor.target);
    assert_eq!(*ddpg.critic.online.parameters, *ddpg.critic.target);
    let before = ddpg.critic.clone();
    ddpg.update(&minibatch(1));
    for i in 0..before.target.len() {
        let expected = 0.01 * ddpg.critic.online.parameters[i] + 0.99 * before.target[i];
        assert!((ddpg.critic.target[i] - expected).abs() < 1e-7);
    }
}

#[test]
fn a_restored_algorithm_continues_with_the_same_bits() {
    let mut ddpg = algorithm(1);
    for t in 0..3 {
        ddpg.update(&minibatch(t));
    }
    let mut restored = Ddpg::new(&spec(), &settings(), 99).unwrap();
    testing::copy_state(&ddpg, &mut restored);
    assert_eq!(restored.state(), ddpg.state());
    assert_eq!(restored.update(&minibatch(7)), ddpg.update(&minibatch(7)));
    assert_eq!(restored.state(), ddpg.state());
}

#[test]
fn actors_compute_the_same_bits_as_the_learner() {
    for hidden in lists() {
        let mut ddpg = algorithm_of(hidden, 1);
        let batch = minibatch(1);
        let range = ActionRange::new(&spec().action).unwrap();
        let mut network = DeterministicPolicy::new(*ddpg.layouts().0, range, BATCH);
        let mut actions = vec![0.0; 2 * BATCH];
        network.forward(ddpg.policy(), batch.s.as_slice(), &mut actions);
        act(
            &mut ddpg.mu,
            &ddpg.range,
            &ddpg.actor.online.parameters,
            batch.s.as_slice(),
            &mut ddpg.actions,
        );
        assert_eq!(actions, ddpg.actions.as_slice(), "{hidden:?}");
    }
}

#[test]
fn discrete_actions_are_refused() {
    let discrete = EnvironmentSpec {
        action: Space::discrete(4),
        ..spec()
    };
    let error = Ddpg::new(&discrete, &settings(), 1).unwrap_err();
    assert!(
        error.to_string().contains("the action space is discrete (4 actions)"),
        "{error}"
    );
}

#[test]
fn a_gradient_step_of_the_thesis_takes_140_million_operations() {
    let pendulum = EnvironmentSpec {
        action: Space::boxed(&[(-2.0, 2.0)]),
        ..spec()
    };
    let products = (&config::DdpgConfig::default()).products(&pendulum);
    assert_eq!(products.products.iter().filter(|p| p.flop() > 15_000_000).count(), 9);
    assert_eq!((products.flop_per_update() as f64 / 1e6).round(), 140.0);
}
