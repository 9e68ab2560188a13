use std::f64::consts::TAU;

use proptest::prelude::*;
use rand::RngExt;
use shoal_base::space::{EnvironmentSpec, Space};
use shoal_base::stream::{Purpose, Stream, stream};

use super::*;
use crate::environment::{Environment, Step, make, names};
use crate::vector::{Reset, tests::Fixture};

const STREAM: [u64; 3] = [11, 2, 3];
/// Steps after the restore: enough for episodes of every environment to end.
const STEPS_AFTER: u32 = 450;

/// Every environment with its default parameters, and the rewards that also depend on the previous action.
fn kinds() -> Vec<(&'static str, &'static str)> {
    let rewards = ["reward = 'r2'", "reward = 'r3'"].map(|reward| ("point-mass", reward));
    names().map(|name| (name, "")).chain(rewards).collect()
}

/// Actions for all environments, some of them outside their box.
fn actions(fixture: &Fixture, rng: &mut Stream) -> Vec<f32> {
    let each = |rng: &mut Stream| match &fixture.vector.spec().action {
        Space::Box { low, high } => (low.iter().zip(high))
            .map(|(low, high)| rng.random_range(1.1 * low - 0.1..=1.1 * high + 0.1))
            .collect(),
        Space::Discrete { n, .. } => vec![rng.random_range(0..*n) as f32],
    };
    (0..fixture.vector.count()).flat_map(|_| each(rng)).collect()
}

fn snapshot(fixture: &Fixture) -> Vec<u64> {
    let mut words = vec![u64::MAX; fixture.vector.snapshot_words()];
    fixture.vector.snapshot(&mut words).unwrap();
    words
}

/// Restores and returns the observations.
fn restore(fixture: &mut Fixture, words: &[u64]) -> Result<Vec<f32>, RequestError> {
    let Fixture {
        vector, observations, ..
    } = fixture;
    vector.restore(words, observations)?;
    Ok(observations.clone())
}

/// All results of a step, as bits.
fn bits(fixture: &Fixture) -> Vec<u32> {
    let blocks = [
        &fixture.observations,
        &fixture.next_observations,
        &fixture.rewards,
        &fixture.terminated,
        &fixture.truncated,
    ];
    blocks
        .iter()
        .flat_map(|block| block.iter().map(|x| x.to_bits()))
        .collect()
}

/// Steps both past the ends of their episodes, and compares them.
fn assert_same_future(one: &mut Fixture, other: &mut Fixture, rng: &mut Stream) {
    for step in 0..STEPS_AFTER {
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
    fn a_new_vector_continues_from_a_snapshot_bit_for_bit(
        (name, parameters) in prop::sample::select(kinds()),
        count in 0_u32..5,
        steps in 0..STEPS_AFTER,
        episode in 0_u64..1 << 39,
        seed in any::<u64>(),
    ) {
        let mut rng = stream(seed, Purpose::Exploration, 0, 0);
        let mut whole = Fixture::of(name, parameters, count, STREAM);
        whole.reset(Reset::Episodes(&vec![episode; count as usize]));
        for _ in 0..steps {
            let actions = actions(&whole, &mut rng);
            whole.step(&actions).unwrap();
        }
        let words = snapshot(&whole);
        let mut fresh = Fixture::of(name, parameters, count, STREAM);
        let observations = restore(&mut fresh, &words).unwrap();
        prop_assert_eq!(&observations, &whole.observations);
        prop_assert_eq!(snapshot(&fresh), words);
        assert_same_future(&mut whole, &mut fresh, &mut rng);
    }

    #[test]
    fn garbage_is_refused_and_changes_nothing(
        (name, parameters) in prop::sample::select(kinds()),
        length in 0_usize..40,
        seed in any::<u64>(),
    ) {
        let mut rng = stream(seed, Purpose::Exploration, 0, 0);
        let mut fixture = Fixture::new(name, parameters, 2);
        fixture.reset(Reset::Next);
        let before = snapshot(&fixture);
        for length in [length, before.len()] {
            let garbage: Vec<u64> = (0..length).map(|_| rng.random()).collect();
            prop_assert!(restore(&mut fixture, &garbage).is_err());
            prop_assert_eq!(&snapshot(&fixture), &before);
        }
    }

    #[test]
    fn a_snapshot_with_one_word_of_garbage_is_refused_or_runs(
        (name, parameters) in prop::sample::select(kinds()),
        place in any::<prop::sample::Index>(),
        garbage in any::<u64>(),
        seed in any::<u64>(),
    ) {
        let mut rng = stream(seed, Purpose::Exploration, 0, 0);
        let mut fixture = Fixture::new(name, parameters, 2);
        fixture.reset(Reset::Next);
        let mut words = snapshot(&fixture);
        *place.get_mut(&mut words) = garbage;
        fixture.reset(Reset::Next);
        let before = snapshot(&fixture);
        let mut fresh = Fixture::new(name, parameters, 2);
        match (restore(&mut fixture, &words), restore(&mut fresh, &words)) {
            (Ok(_), Ok(_)) => assert_same_future(&mut fixture, &mut fresh, &mut rng),
            (Err(_), Err(_)) => prop_assert_eq!(snapshot(&fixture), before),
            other => panic!("the result depends on the current state: {other:?}"),
        }
    }
}

#[test]
fn whole_turns_and_the_sign_of_zero_are_kept() {
    let mut whole = Fixture::new("pendulum", "", 2);
    whole.reset(Reset::States(&[-0.0, -0.0, 1e6 * TAU + 0.1, 3.0]));
    let words = snapshot(&whole);
    assert_eq!(words[3..5], [(-0.0_f64).to_bits(); 2]);
    let mut fresh = Fixture::new("pendulum", "", 2);
    restore(&mut fresh, &words).unwrap();
    assert_eq!(snapshot(&fresh), words);
    let mut rng = stream(5, Purpose::Exploration, 0, 0);
    assert_same_future(&mut whole, &mut fresh, &mut rng);
}

#[test]
fn a_value_that_no_episode_can_have_is_refused_by_name() {
    let mut fixture = Fixture::new("cart-pole", "time_limit = 9", 2);
    fixture.reset(Reset::Next);
    let words = snapshot(&fixture);
    fixture.reset(Reset::Next);
    let before = snapshot(&fixture);
    let mut refusal = |place: usize, word: u64| {
        let mut words = words.clone();
        words[place] = word;
        restore(&mut fixture, &words).unwrap_err().to_string()
    };
    assert_eq!(
        refusal(7, 1 << 40),
        "invalid snapshot: environment 1 cannot have this episode"
    );
    assert_eq!(
        refusal(8, 9),
        "invalid snapshot: environment 1 cannot have this number of steps"
    );
    assert!(refusal(10, f64::NAN.to_bits()).contains("cannot be in state [NaN"));
    assert_eq!(
        restore(&mut fixture, &words[1..]).unwrap_err().to_string(),
        "snapshot: 13 numbers for 2 environments; give 7 each"
    );
    assert_eq!(snapshot(&fixture), before, "nothing has changed");
}

#[test]
fn only_training_has_snapshots_and_a_restore_returns_to_it() {
    let mut fixture = Fixture::new("frozen-lake", "", 2);
    let mut words = vec![0; fixture.vector.snapshot_words()];
    assert_eq!(fixture.vector.snapshot(&mut words), Err(RequestError::NoTraining));
    fixture.reset(Reset::Next);
    let training = snapshot(&fixture);
    fixture.reset(Reset::Evaluation {
        seed: 1,
        first: 0,
        episodes: None,
    });
    assert_eq!(fixture.vector.snapshot(&mut words), Err(RequestError::NoTraining));
    restore(&mut fixture, &training).unwrap();
    assert_eq!(snapshot(&fixture), training);
}

#[test]
fn a_restored_environment_continues_even_if_it_had_run_all_its_evaluation_episodes() {
    let mut fixture = Fixture::new("pendulum", "", 2);
    fixture.reset(Reset::Next);
    let training = snapshot(&fixture);
    let mut undisturbed = Fixture::new("pendulum", "", 2);
    restore(&mut undisturbed, &training).unwrap();
    fixture.reset(Reset::Evaluation {
        seed: 1,
        first: 0,
        episodes: Some(1),
    });
    restore(&mut fixture, &training).unwrap();
    let mut rng = stream(5, Purpose::Exploration, 0, 0);
    assert_same_future(&mut undisturbed, &mut fixture, &mut rng);
}

/// An environment that cannot save its state, as an external one may be.
struct Unsaved(Box<dyn Environment>);

impl Environment for Unsaved {
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
fn an_environment_that_cannot_save_its_state_refuses_snapshots() {
    let mut fixture = Fixture::new("pendulum", "", 1);
    let vector = &mut fixture.vector;
    vector.scratch = Box::new(Unsaved(make("pendulum", &toml::Table::new()).unwrap()));
    vector.spec = vector.scratch.spec();
    fixture.reset(Reset::Next);
    assert_eq!(fixture.vector.snapshot_words(), 0);
    assert_eq!(fixture.vector.snapshot(&mut []), Err(RequestError::NoSnapshots));
    assert_eq!(restore(&mut fixture, &[]), Err(RequestError::NoSnapshots));
}
