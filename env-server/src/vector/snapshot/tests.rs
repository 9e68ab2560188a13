use std::f64::consts::TAU;

use proptest::prelude::*;
use rand::RngExt;
use shoal_base::space::{EnvironmentSpec, Space};
use shoal_base::stream::{Purpose, Stream, stream};

use super::*;
use crate::environment::{Environment, Step, make, names};
use crate::vector::{Start, tests::Bench};

const NAME: [u64; 3] = [11, 2, 3];
/// Crosses the ends of episodes of every environment.
const AFTERWARDS: u32 = 450;

/// Every environment with its default parameters, and those whose parameters say what the future depends on.
fn kinds() -> Vec<(&'static str, &'static str)> {
    let rates = ["reward = 'r2'", "reward = 'r3'"].map(|reward| ("point-mass", reward));
    names().map(|name| (name, "")).chain(rates).collect()
}

/// Actions for all environments, some of them beyond their box.
fn actions(bench: &Bench, rng: &mut Stream) -> Vec<f32> {
    let each = |rng: &mut Stream| match &bench.vector.spec().action {
        Space::Box { low, high } => (low.iter().zip(high))
            .map(|(low, high)| rng.random_range(1.1 * low - 0.1..=1.1 * high + 0.1))
            .collect(),
        Space::Discrete { n, .. } => vec![rng.random_range(0..*n) as f32],
    };
    (0..bench.vector.count()).flat_map(|_| each(rng)).collect()
}

fn snapshot(bench: &Bench) -> Vec<u64> {
    let mut words = vec![u64::MAX; bench.vector.snapshot_words()];
    bench.vector.snapshot(&mut words).unwrap();
    words
}

/// Restores and gives the observations.
fn restore(bench: &mut Bench, words: &[u64]) -> Result<Vec<f32>, RequestError> {
    let Bench {
        vector, observations, ..
    } = bench;
    vector.restore(words, observations)?;
    Ok(observations.clone())
}

/// All that a step gave, as bits.
fn bits(bench: &Bench) -> Vec<u32> {
    let blocks = [
        &bench.observations,
        &bench.next_observations,
        &bench.rewards,
        &bench.terminated,
        &bench.truncated,
    ];
    blocks
        .iter()
        .flat_map(|block| block.iter().map(|x| x.to_bits()))
        .collect()
}

/// Steps both and compares, to beyond the ends of their episodes.
fn go_on_alike(one: &mut Bench, other: &mut Bench, rng: &mut Stream) {
    for step in 0..AFTERWARDS {
        let actions = actions(one, rng);
        one.step(&actions).unwrap();
        other.step(&actions).unwrap();
        assert_eq!(bits(one), bits(other), "step {step}");
    }
    assert_eq!(snapshot(one), snapshot(other));
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_fresh_vector_goes_on_from_a_snapshot_bit_for_bit(
        (name, parameters) in prop::sample::select(kinds()),
        count in 0_u32..5,
        steps in 0..AFTERWARDS,
        episode in 0_u64..1 << 39,
        seed in any::<u64>(),
    ) {
        let mut rng = stream(seed, Purpose::Exploration, 0, 0);
        let mut whole = Bench::of(name, parameters, count, NAME);
        whole.reset(Start::Episodes(&vec![episode; count as usize]));
        for _ in 0..steps {
            let actions = actions(&whole, &mut rng);
            whole.step(&actions).unwrap();
        }
        let words = snapshot(&whole);
        let mut fresh = Bench::of(name, parameters, count, NAME);
        let observations = restore(&mut fresh, &words).unwrap();
        prop_assert_eq!(&observations, &whole.observations);
        prop_assert_eq!(snapshot(&fresh), words);
        go_on_alike(&mut whole, &mut fresh, &mut rng);
    }

    #[test]
    fn garbage_is_refused_and_changes_nothing(
        (name, parameters) in prop::sample::select(kinds()),
        length in 0_usize..40,
        seed in any::<u64>(),
    ) {
        let mut rng = stream(seed, Purpose::Exploration, 0, 0);
        let mut bench = Bench::new(name, parameters, 2);
        bench.reset(Start::Next);
        let before = snapshot(&bench);
        for length in [length, before.len()] {
            let garbage: Vec<u64> = (0..length).map(|_| rng.random()).collect();
            prop_assert!(restore(&mut bench, &garbage).is_err());
            prop_assert_eq!(&snapshot(&bench), &before);
        }
    }

    #[test]
    fn a_snapshot_with_a_word_of_garbage_is_refused_or_runs(
        (name, parameters) in prop::sample::select(kinds()),
        place in any::<prop::sample::Index>(),
        garbage in any::<u64>(),
        seed in any::<u64>(),
    ) {
        let mut rng = stream(seed, Purpose::Exploration, 0, 0);
        let mut bench = Bench::new(name, parameters, 2);
        bench.reset(Start::Next);
        let mut words = snapshot(&bench);
        *place.get_mut(&mut words) = garbage;
        bench.reset(Start::Next);
        let before = snapshot(&bench);
        let mut fresh = Bench::new(name, parameters, 2);
        match (restore(&mut bench, &words), restore(&mut fresh, &words)) {
            (Ok(_), Ok(_)) => go_on_alike(&mut bench, &mut fresh, &mut rng),
            (Err(_), Err(_)) => prop_assert_eq!(snapshot(&bench), before),
            other => panic!("the present state decided: {other:?}"),
        }
    }
}

#[test]
fn whole_turns_and_the_sign_of_zero_are_kept() {
    let mut whole = Bench::new("pendulum", "", 2);
    whole.reset(Start::States(&[-0.0, -0.0, 1e6 * TAU + 0.1, 3.0]));
    let words = snapshot(&whole);
    assert_eq!(words[3..5], [(-0.0_f64).to_bits(); 2]);
    let mut fresh = Bench::new("pendulum", "", 2);
    restore(&mut fresh, &words).unwrap();
    assert_eq!(snapshot(&fresh), words);
    let mut rng = stream(5, Purpose::Exploration, 0, 0);
    go_on_alike(&mut whole, &mut fresh, &mut rng);
}

#[test]
fn what_no_episode_can_come_to_is_refused_by_name() {
    let mut bench = Bench::new("cart-pole", "time_limit = 9", 2);
    bench.reset(Start::Next);
    let words = snapshot(&bench);
    bench.reset(Start::Next);
    let before = snapshot(&bench);
    let mut refusal = |place: usize, word: u64| {
        let mut words = words.clone();
        words[place] = word;
        restore(&mut bench, &words).unwrap_err().to_string()
    };
    assert_eq!(
        refusal(7, 1 << 40),
        "no snapshot: environment 1 cannot have this episode"
    );
    assert_eq!(
        refusal(8, 9),
        "no snapshot: environment 1 cannot have this number of steps"
    );
    assert!(refusal(10, f64::NAN.to_bits()).contains("cannot be in state [NaN"));
    assert_eq!(
        restore(&mut bench, &words[1..]).unwrap_err().to_string(),
        "13 numbers of snapshot for 2 environments: give 7 each"
    );
    assert_eq!(snapshot(&bench), before, "and nothing has changed");
}

#[test]
fn there_are_snapshots_of_training_alone_and_a_restore_goes_back_to_it() {
    let mut bench = Bench::new("frozen-lake", "", 2);
    let mut words = vec![0; bench.vector.snapshot_words()];
    assert_eq!(bench.vector.snapshot(&mut words), Err(RequestError::NoTraining));
    bench.reset(Start::Next);
    let training = snapshot(&bench);
    bench.reset(Start::Evaluation {
        seed: 1,
        first: 0,
        episodes: None,
    });
    assert_eq!(bench.vector.snapshot(&mut words), Err(RequestError::NoTraining));
    restore(&mut bench, &training).unwrap();
    assert_eq!(snapshot(&bench), training);
}

/// As one of another maker would be: it has a state, and no way to say it.
struct Foreign(Box<dyn Environment>);

impl Environment for Foreign {
    fn spec(&self) -> EnvironmentSpec {
        EnvironmentSpec {
            state_width: 0,
            ..self.0.spec()
        }
    }

    fn reset(&mut self, rng: &mut Stream) {
        self.0.reset(rng);
    }

    fn reset_to(&mut self, state: &[f64]) -> Result<(), RequestError> {
        self.0.reset_to(state)
    }

    fn observe(&self, observation: &mut [f32]) {
        self.0.observe(observation);
    }

    fn step(&mut self, action: &[f64], rng: &mut Stream) -> Step {
        self.0.step(action, rng)
    }
}

#[test]
fn an_environment_that_cannot_say_its_state_says_that() {
    let mut bench = Bench::new("pendulum", "", 1);
    let vector = &mut bench.vector;
    vector.trial = Box::new(Foreign(make("pendulum", &toml::Table::new()).unwrap()));
    vector.spec = vector.trial.spec();
    bench.reset(Start::Next);
    assert_eq!(bench.vector.snapshot_words(), 0);
    assert_eq!(bench.vector.snapshot(&mut []), Err(RequestError::Unsayable));
    assert_eq!(restore(&mut bench, &[]), Err(RequestError::Unsayable));
}
