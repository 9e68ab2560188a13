use super::*;

/// A vector with the buffers that a server has in shared memory.
pub(super) struct Fixture {
    pub(super) vector: VectorEnvironment,
    pub(super) observations: Vec<f32>,
    pub(super) next_observations: Vec<f32>,
    pub(super) rewards: Vec<f32>,
    pub(super) terminated: Vec<f32>,
    pub(super) truncated: Vec<f32>,
}

impl Fixture {
    pub(super) fn of(name: &str, parameters: &str, count: u32, [seed, server, incarnation]: [u64; 3]) -> Self {
        let parameters = parameters.parse().unwrap();
        let vector = VectorEnvironment::new(name, &parameters, count, seed, server, incarnation).unwrap();
        let width = vector.spec().observation.width();
        let nans = |n| vec![f32::NAN; count as usize * n];
        Self {
            observations: nans(width),
            next_observations: nans(width),
            rewards: nans(1),
            terminated: nans(1),
            truncated: nans(1),
            vector,
        }
    }

    pub(super) fn new(name: &str, parameters: &str, count: u32) -> Self {
        Self::of(name, parameters, count, [1, 0, 0])
    }

    pub(super) fn reset(&mut self, start: Reset<'_>) -> Vec<f32> {
        self.vector.reset(start, &mut self.observations).unwrap();
        self.observations.clone()
    }

    pub(super) fn step(&mut self, actions: &[f32]) -> Result<(), RequestError> {
        let Self {
            vector,
            observations,
            next_observations,
            rewards,
            terminated,
            truncated,
        } = self;
        vector.step(
            actions,
            StepBlocks {
                observations,
                next_observations,
                rewards,
                terminated,
                truncated,
            },
        )
    }
}

#[test]
fn the_time_limit_truncates_and_the_next_episode_begins() {
    let mut fixture = Fixture::new("pendulum", "time_limit = 3", 2);
    fixture.reset(Reset::Next);
    for step in 1..=7 {
        fixture.step(&[0.5, -0.5]).unwrap();
        let ended = if step % 3 == 0 { 1.0 } else { 0.0 };
        assert_eq!(fixture.truncated, [ended; 2], "step {step}");
        assert_eq!(fixture.terminated, [0.0; 2]);
        assert_eq!(
            fixture.observations != fixture.next_observations,
            ended == 1.0,
            "step {step}"
        );
        assert!(fixture.rewards.iter().all(|r| *r < 0.0));
    }
    let mut from_the_start = Fixture::new("pendulum", "", 2);
    let third = from_the_start.reset(Reset::Episodes(&[2, 2]));
    fixture.reset(Reset::Episodes(&[1, 1]));
    for _ in 0..3 {
        fixture.step(&[0.0, 0.0]).unwrap();
    }
    assert_eq!(
        fixture.observations, third,
        "the automatic reset started the next episode"
    );
}

#[test]
fn termination_in_the_last_step_is_not_truncation() {
    // The number of the step in which the pole falls if it is always pushed the same way.
    let fall = {
        let mut fixture = Fixture::new("cart-pole", "", 1);
        fixture.reset(Reset::States(&[0.0; 4]));
        (1..).find(|_| {
            fixture.step(&[1.0]).unwrap();
            fixture.terminated == [1.0]
        })
    }
    .unwrap();
    for (time_limit, ended) in [
        (fall - 1, ([0.0], [1.0])),
        (fall, ([1.0], [0.0])),
        (fall + 1, ([1.0], [0.0])),
    ] {
        let mut fixture = Fixture::new("cart-pole", &format!("time_limit = {time_limit}"), 1);
        fixture.reset(Reset::States(&[0.0; 4]));
        for _ in 0..time_limit.min(fall) - 1 {
            fixture.step(&[1.0]).unwrap();
            assert_eq!((fixture.terminated[0], fixture.truncated[0]), (0.0, 0.0));
        }
        fixture.step(&[1.0]).unwrap();
        assert_eq!(
            (fixture.terminated[..].as_ref(), fixture.truncated[..].as_ref()),
            (&ended.0[..], &ended.1[..])
        );
        assert!(
            fixture.next_observations[2].abs() > 0.1,
            "s' is the state the pole fell into"
        );
        assert!(
            fixture.observations.iter().all(|x| x.abs() <= 0.05),
            "this is the next episode's start"
        );
        fixture.step(&[1.0]).unwrap();
        assert_eq!(
            (fixture.terminated[0], fixture.truncated[0]),
            (0.0, 0.0),
            "the steps are counted from 0 again"
        );
    }
}

#[test]
fn every_counter_changes_the_start_states() {
    let starts = |name: [u64; 3]| Fixture::of("point-mass", "", 3, name).reset(Reset::Next);
    let base = starts([1, 0, 0]);
    assert_eq!(base, starts([1, 0, 0]));
    assert!(
        base[..2] != base[6..8] && base[6..8] != base[12..14],
        "each environment has its own start state"
    );
    for other in [[2, 0, 0], [1, 1, 0], [1, 0, 1]] {
        assert_ne!(base[..6], starts(other)[..6], "{other:?}");
    }
    let mut fixture = Fixture::new("point-mass", "", 3);
    assert_eq!(fixture.reset(Reset::Next), base);
    let second = fixture.reset(Reset::Next);
    assert_ne!(second[..6], base[..6]);
    assert_eq!(
        Fixture::new("point-mass", "", 3).reset(Reset::Episodes(&[1, 1, 1])),
        second
    );
    assert_eq!(fixture.reset(Reset::Episodes(&[0, 0, 0])), base);
}

#[test]
fn an_evaluation_episode_always_starts_the_same_way() {
    let evaluation = |first| Reset::Evaluation {
        seed: 9,
        first,
        episodes: None,
    };
    let five = Fixture::of("pendulum", "", 5, [1, 0, 0]).reset(evaluation(0));
    let mut other = Fixture::of("pendulum", "time_limit = 2", 2, [2, 3, 4]);
    other.reset(Reset::Next);
    other.step(&[0.1, 0.2]).unwrap();
    assert_eq!(other.reset(evaluation(0)), five[..6]);
    for _ in 0..2 {
        other.step(&[1.0, -1.0]).unwrap();
    }
    assert_eq!(
        other.observations,
        five[6..12],
        "environment e continues with the episode E later"
    );
    assert_eq!(other.reset(evaluation(3)), five[9..]);
    assert_ne!(
        other.reset(Reset::Evaluation {
            seed: 8,
            first: 3,
            episodes: None
        }),
        five[9..]
    );
    assert_ne!(five[..3], five[3..6]);
}

#[test]
fn evaluation_does_not_disturb_training_episodes() {
    let mut fixture = Fixture::new("pendulum", "", 1);
    fixture.reset(Reset::Next);
    fixture.reset(Reset::Evaluation {
        seed: 1,
        first: 0,
        episodes: None,
    });
    let second = fixture.reset(Reset::Next);
    assert_eq!(second, Fixture::new("pendulum", "", 1).reset(Reset::Episodes(&[1])));
}

#[test]
fn a_repeated_frozen_lake_episode_slips_the_same_way() {
    let states = |fixture: &mut Fixture| -> Vec<f32> {
        let step = |_| {
            fixture.step(&[2.0]).unwrap();
            fixture.next_observations[0]
        };
        (0..20).map(step).collect()
    };
    let mut fixture = Fixture::new("frozen-lake", "", 1);
    fixture.reset(Reset::Next);
    let first = states(&mut fixture);
    fixture.reset(Reset::Episodes(&[0]));
    assert_eq!(states(&mut fixture), first);
    fixture.reset(Reset::Episodes(&[100]));
    assert_ne!(states(&mut fixture), first);
}

#[test]
fn episodes_start_from_given_states() {
    let mut fixture = Fixture::new("point-mass", "", 2);
    let observations = fixture.reset(Reset::States(&[3.0, 4.0, 0.0, 0.0, -2.0, 0.0, 0.5, 0.0]));
    assert_eq!(
        observations,
        [3.0, 4.0, 0.0, 0.0, 5.0, 0.0, -2.0, 0.0, 0.5, 0.0, 2.0, -0.5]
    );
    let mut refusal = |states| {
        fixture
            .vector
            .reset(Reset::States(states), &mut fixture.observations)
            .unwrap_err()
    };
    assert!(matches!(refusal(&[0.0; 7]), RequestError::Count { given: 7, .. }));
    assert!(matches!(refusal(&[0.0; 6]), RequestError::State { .. }));
    assert!(matches!(refusal(&[]), RequestError::State { .. }));
    let outside = refusal(&[0.0, 0.0, 0.0, 0.0, 9.0, 0.0, 0.0, 0.0]).to_string();
    assert!(
        outside.contains("9.0") && outside.contains("within -4 to 4 m"),
        "{outside}"
    );
}

#[test]
fn a_refused_action_changes_nothing() {
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut fixture = Fixture::new("pendulum", "", 2);
        fixture.reset(Reset::Next);
        assert!(matches!(
            fixture.step(&[1.0, bad]),
            Err(RequestError::Action { environment: 1, .. })
        ));
        assert!(fixture.rewards[0].is_nan(), "nothing was written");
        fixture.step(&[1.0, 1.0]).unwrap();
        let mut undisturbed = Fixture::new("pendulum", "", 2);
        undisturbed.reset(Reset::Next);
        undisturbed.step(&[1.0, 1.0]).unwrap();
        assert_eq!(fixture.observations, undisturbed.observations);
    }
    let mut cart_pole = Fixture::new("cart-pole", "", 1);
    cart_pole.reset(Reset::Next);
    for bad in [2.0, -1.0, 0.5, f32::NAN] {
        assert!(
            matches!(cart_pole.step(&[bad]), Err(RequestError::Action { .. })),
            "{bad}"
        );
    }
    let short = Fixture::new("point-mass", "", 2)
        .step(&[0.0; 3])
        .unwrap_err()
        .to_string();
    assert_eq!(short, "actions: 3 numbers for 2 environments; give 2 each");
}

#[test]
fn actions_outside_the_box_are_clipped() {
    let reward = |action| {
        let mut fixture = Fixture::new("pendulum", "", 1);
        fixture.reset(Reset::States(&[0.0, 0.0]));
        fixture.step(&[action]).unwrap();
        (fixture.rewards[0], fixture.observations)
    };
    assert_eq!(reward(2.0), reward(1e30));
}

#[test]
fn parameters_are_checked_before_any_environment_runs() {
    let refused = VectorEnvironment::new("pendulum", &"time_limit = 0".parse().unwrap(), 2, 1, 0, 0);
    assert!(matches!(
        refused,
        Err(EnvironmentError::Parameters {
            environment: "pendulum",
            ..
        })
    ));
}
