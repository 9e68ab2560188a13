use rand::RngExt;
use shoal_common::network::{Activation, Layers, Network};
use shoal_common::space::Space;
use shoal_common::stream::{Purpose, stream};

use super::*;

const SIZES: RunSizes = RunSizes {
    capacity: 100,
    chunk_rows: 12,
    actors: 2,
    envs: 1,
};

fn spec() -> EnvironmentSpec {
    EnvironmentSpec {
        observation: Space::boxed(&[(-1.0, 1.0); 3]),
        action: Space::discrete(3),
        time_limit: 12,
        state_width: 1,
    }
}

fn settings(weight: ReturnWeighting) -> config::ReinforceConfig {
    config::ReinforceConfig {
        hidden: [7, 5].into(),
        baseline_hidden: [6, 4].into(),
        weight,
        ..config::ReinforceConfig::default()
    }
}

/// An algorithm whose output layers are as large as the others, so that every gradient is well above rounding errors.
fn algorithm(settings: &config::ReinforceConfig) -> Reinforce {
    let mut algorithm = Reinforce::new(settings, &spec(), 1, SIZES).unwrap();
    let mut numbers = stream(1, Purpose::Sampling, 0, 0);
    for NetworkWithPass { network, .. } in std::iter::once(&mut algorithm.policy).chain(&mut algorithm.baseline) {
        network
            .parameters
            .iter_mut()
            .for_each(|x| *x = numbers.random_range(-0.7..0.7));
    }
    algorithm
}

/// An episode of distinct numbers, terminated or ended by the time limit.
struct Episode {
    s: Vec<[f32; 3]>,
    a: Vec<[f32; 1]>,
    r: Vec<f32>,
    terminated: bool,
}

impl Episode {
    fn random(seed: u64, steps: usize, terminated: bool) -> Self {
        let mut numbers = stream(seed, Purpose::Environment, 0, 0);
        Self {
            s: (0..steps)
                .map(|_| std::array::from_fn(|_| numbers.random_range(-1.0..1.0)))
                .collect(),
            a: (0..steps).map(|_| [numbers.random_range(0..3_u8).into()]).collect(),
            r: (0..steps).map(|_| numbers.random_range(-1.0..2.0)).collect(),
            terminated,
        }
    }

    fn steps(&self) -> Vec<Transition<'_>> {
        let end = self.r.len() - 1;
        let step = |t: usize| Transition {
            s: &self.s[t],
            a: &self.a[t],
            r: self.r[t],
            discount: if t == end && self.terminated { 0.0 } else { 0.9 },
            s_next: &[9.0; 3],
            last: t == end,
        };
        (0..=end).map(step).collect()
    }

    /// Σ γᵏ r from each step on, each sum computed separately.
    fn returns(&self) -> Vec<f64> {
        let tail = |t: usize| {
            (t..self.r.len())
                .map(|k| 0.9_f64.powi((k - t) as i32) * f64::from(self.r[k]))
                .sum()
        };
        (0..self.r.len()).map(tail).collect()
    }
}

/// The network's output for one sample: logits, or V(s).
fn output(layout: &NetworkLayout, parameters: &[f32], s: &[f32]) -> Vec<f64> {
    let mut out = vec![0.0; layout.outputs()];
    Network::new(*layout, 1).forward(parameters, s, &mut out);
    out.into_iter().map(f64::from).collect()
}

fn ln_pi(layout: &NetworkLayout, parameters: &[f32], step: &Transition<'_>) -> f64 {
    let logits = output(layout, parameters, step.s);
    logits[step.a[0] as usize] - logits.iter().map(|logit| logit.exp()).sum::<f64>().ln()
}

/// Mean over the episodes of the mean over the steps of weight · ln π, which a gradient step increases.
fn objective(layout: &NetworkLayout, parameters: &[f32], episodes: &[(&Episode, Vec<f64>)]) -> f64 {
    let of = |(episode, weights): &(&Episode, Vec<f64>)| {
        let steps = episode.steps();
        let terms = steps
            .iter()
            .zip(weights)
            .map(|(step, weight)| weight * ln_pi(layout, parameters, step));
        terms.sum::<f64>() / steps.len() as f64
    };
    episodes.iter().map(of).sum::<f64>() / episodes.len() as f64
}

fn assert_finite_differences(
    layout: &NetworkLayout,
    parameters: &[f32],
    gradient: &[f32],
    f: impl Fn(&NetworkLayout, &[f32]) -> f64,
) {
    let h = 2e-3;
    let mut compared = 0;
    for i in (0..parameters.len()).step_by(3) {
        let mut moved = parameters.to_vec();
        let mut at = |by: f32| {
            moved[i] = parameters[i] + by;
            f(layout, &moved)
        };
        let (minus, here, plus) = (at(-h), at(0.0), at(h));
        let [left, right] = [here - minus, plus - here].map(|rise| rise / f64::from(h));
        // A ReLU whose input changes sign within h has two slopes here.
        if (left - right).abs() > 3e-4 + 1e-2 * left.abs() {
            continue;
        }
        let slope = (left + right) / 2.0;
        let found = f64::from(gradient[i]);
        assert!(
            (found - slope).abs() < 1e-3 + 1e-2 * slope.abs(),
            "parameter {i}: {found}, and {slope}"
        );
        compared += 1;
    }
    assert!(compared > parameters.len() / 5, "only {compared} were compared");
    assert!(gradient.iter().any(|g| g.abs() > 1e-2), "there is something to compare");
}

#[test]
fn the_gradient_is_that_of_the_objective() {
    let (long, short) = (Episode::random(1, 12, false), Episode::random(2, 5, true));
    let steps = [long.steps(), short.steps()].concat();
    let lists: [Layers; 4] = [
        [7, 5].into(),
        [9].into(),
        [7, 6, 5].into(),
        [6, 5, 7, 6, 5, 6, 7, 5].into(),
    ];
    for ((weight, discount_steps), (hidden, activation)) in [
        (ReturnWeighting::Return, false),
        (ReturnWeighting::Return, true),
        (ReturnWeighting::Normalised, false),
    ]
    .into_iter()
    .flat_map(|weight| {
        let both = lists.map(|list| [(list, Activation::Relu), (list, Activation::Tanh)]);
        both.concat().into_iter().map(move |hidden| (weight, hidden))
    }) {
        let settings = config::ReinforceConfig {
            discount_steps,
            hidden,
            activation,
            ..settings(weight)
        };
        let mut algorithm = algorithm(&settings);
        let before = algorithm.policy.network.parameters.to_vec();
        algorithm.learn(&steps);
        let weights = |episode: &Episode| -> Vec<f64> {
            let returns = episode.returns();
            let n = returns.len() as f64;
            let mean = returns.iter().sum::<f64>() / n;
            let std = (returns.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / n).sqrt();
            let weight_of = |(t, g): (usize, &f64)| match weight {
                ReturnWeighting::Normalised => (g - mean) / std,
                _ if discount_steps => 0.9_f64.powi(t as i32) * g,
                _ => *g,
            };
            returns.iter().enumerate().map(weight_of).collect()
        };
        let episodes = [(&long, weights(&long)), (&short, weights(&short))];
        let descended = algorithm.policy.network.gradient.to_vec();
        assert_finite_differences(
            &algorithm.policy.network.layout,
            &before,
            &descended,
            |layout, parameters| -objective(layout, parameters, &episodes),
        );
    }
}

#[test]
fn the_baseline_is_subtracted_from_the_return_and_learns_it() {
    let episode = Episode::random(3, 12, true);
    let mut algorithm = algorithm(&settings(ReturnWeighting::Baseline));
    let before = algorithm.policy.network.parameters.to_vec();
    let baseline = algorithm.baseline.as_ref().unwrap();
    let (layout, values) = (baseline.network.layout, baseline.network.parameters.to_vec());
    algorithm.learn(&episode.steps());
    let deltas = |values: &[f32]| -> Vec<f64> {
        let steps = episode.steps();
        let each = steps.iter().zip(episode.returns());
        each.map(|(step, g)| g - output(&layout, values, step.s)[0]).collect()
    };
    let weights = [(&episode, deltas(&values))];
    let descended = algorithm.policy.network.gradient.to_vec();
    assert_finite_differences(
        &algorithm.policy.network.layout,
        &before,
        &descended,
        |layout, parameters| -objective(layout, parameters, &weights),
    );
    let descended = algorithm.baseline.as_ref().unwrap().network.gradient.to_vec();
    assert_finite_differences(&layout, &values, &descended, |_, values| {
        deltas(values).iter().map(|delta| delta * delta / 2.0).sum::<f64>() / 12.0
    });
}

#[test]
fn only_complete_episodes_are_learned_from_and_those_at_the_limit_only_if_configured() {
    let (cut, over) = (Episode::random(1, 12, false), Episode::random(2, 5, true));
    let mut skips = algorithm(&config::ReinforceConfig {
        learn_at_limit: false,
        ..settings(ReturnWeighting::Return)
    });
    let before = skips.policy.network.parameters.to_vec();
    assert_eq!(skips.learn(&cut.steps()), None);
    assert_eq!(*skips.policy.network.parameters, before);
    assert_eq!(skips.steps, [0.0]);

    let mut learns = algorithm(&settings(ReturnWeighting::Return));
    learns.learn(&cut.steps());
    assert_ne!(*learns.policy.network.parameters, before);

    // From a round with both, `skips` learns only from the episode that terminated.
    let mut alone = skips.clone();
    alone.learn(&over.steps());
    skips.learn(&[cut.steps(), over.steps()].concat());
    assert_eq!(*skips.policy.network.parameters, *alone.policy.network.parameters);
    let mut unfinished = learns.clone();
    unfinished.learn(&over.steps()[..4]);
    assert_eq!(*unfinished.policy.network.parameters, *learns.policy.network.parameters);
}

#[test]
fn an_episode_of_equal_returns_changes_nothing_when_normalised() {
    let mut algorithm = algorithm(&settings(ReturnWeighting::Normalised));
    let before = algorithm.policy.network.parameters.to_vec();
    algorithm.learn(&Episode::random(4, 1, true).steps());
    assert_eq!(*algorithm.policy.network.parameters, before);
}

#[test]
fn a_restored_state_continues_with_the_same_bits() {
    let rounds: Vec<Episode> = (0..4).map(|seed| Episode::random(seed, 9, true)).collect();
    let mut straight = algorithm(&settings(ReturnWeighting::Baseline));
    for round in &rounds[..2] {
        straight.learn(&round.steps());
    }
    let arrays = straight
        .state()
        .into_iter()
        .map(|(name, numbers)| (name.into(), numbers.into()));
    let mut saved = SavedState::from(arrays.collect::<Vec<_>>());
    let mut resumed = Reinforce::new(&settings(ReturnWeighting::Baseline), &spec(), 2, SIZES).unwrap();
    resumed.restore(18, &mut saved).unwrap();
    for algorithm in [&mut straight, &mut resumed] {
        for round in &rounds[2..] {
            algorithm.learn(&round.steps());
        }
    }
    assert_eq!(straight.state(), resumed.state());
}
