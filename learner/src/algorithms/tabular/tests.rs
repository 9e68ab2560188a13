use shoal_common::space::Space;

use super::*;

const SIZES: RunSizes = RunSizes {
    capacity: 100,
    chunk_rows: 4,
    actors: 2,
    envs: 2,
};

fn lake(states: u32, actions: u32) -> EnvironmentSpec {
    EnvironmentSpec {
        observation: Space::discrete(states),
        action: Space::discrete(actions),
        time_limit: 100,
        state_width: 1,
    }
}

fn table(bootstrap: Bootstrap, alpha: f64) -> Tabular {
    let settings = config::TabularConfig {
        alpha,
        ..config::TabularConfig::default()
    };
    Tabular::new(bootstrap, &settings, &lake(3, 2), SIZES).unwrap()
}

/// s, a, r, discount, s', last
type Row = (usize, usize, f32, f32, usize, bool);

fn teach(table: &mut Tabular, environment: usize, (s, a, r, discount, s_next, last): Row) {
    let transition = Transition {
        s: &[s as f32],
        a: &[a as f32],
        r,
        discount,
        s_next: &[s_next as f32],
        last,
    };
    table.learn(&transition, environment);
}

#[test]
fn q_learning_uses_the_best_action_of_the_next_state() {
    let mut table = table(Bootstrap::Max, 0.5);
    table.q = vec![1.0, 2.0, 10.0, 30.0, 0.0, 0.0];
    teach(&mut table, 0, (0, 1, 4.0, 0.5, 1, false));
    // 2 + ½ (4 + ½ · 30 − 2)
    assert_eq!(table.q, [1.0, 10.5, 10.0, 30.0, 0.0, 0.0]);
    teach(&mut table, 0, (1, 0, 1.0, 0.0, 0, true));
    assert_eq!(table.q[2], 5.5, "a terminal state has no value");
    teach(&mut table, 0, (0, 0, 0.0, 0.5, 1, true));
    assert_eq!(
        table.q[0], 8.0,
        "a state at the time limit has a value: 1 + ½ (½ · 30 − 1)"
    );
}

#[test]
fn sarsa_uses_the_next_action_of_the_same_environment() {
    let mut table = table(Bootstrap::NextAction, 0.5);
    table.q = vec![1.0, 2.0, 10.0, 30.0, 0.0, 0.0];
    teach(&mut table, 0, (0, 1, 4.0, 0.5, 1, false));
    // Another environment's step is not its successor.
    teach(&mut table, 1, (2, 0, 0.0, 0.5, 1, false));
    assert_eq!(table.q, [1.0, 2.0, 10.0, 30.0, 0.0, 0.0], "before a' is known");
    teach(&mut table, 0, (1, 0, 8.0, 0.0, 2, true));
    // 2 + ½ (4 + ½ · 10 − 2), and then 10 + ½ (8 − 10)
    assert_eq!(table.q, [1.0, 5.5, 9.0, 30.0, 0.0, 0.0]);
    teach(&mut table, 0, (0, 0, 100.0, 0.5, 1, true));
    teach(&mut table, 0, (1, 0, 0.0, 0.5, 1, false));
    assert_eq!(table.q[0], 1.0, "a step at the time limit has no next action");
    // The other environment's step: 0 + ½ (0 + ½ · 30 − 0)
    teach(&mut table, 1, (1, 1, 0.0, 0.5, 1, false));
    assert_eq!(table.q[4], 7.5);
}

#[test]
fn the_number_of_a_row_determines_its_environment() {
    // Two actors with two environments each, two steps a chunk.
    let table = table(Bootstrap::NextAction, 0.5);
    let environments: Vec<usize> = (0..12).map(|row| table.environment(row)).collect();
    assert_eq!(environments, [0, 1, 0, 1, 2, 3, 2, 3, 0, 1, 0, 1]);
}

#[test]
fn a_state_reads_back_and_an_incomplete_one_is_refused() {
    let mut old = table(Bootstrap::NextAction, 0.5);
    teach(&mut old, 3, (0, 1, 4.0, 0.5, 1, false));
    teach(&mut old, 1, (1, 1, 4.0, 0.0, 1, true));
    let arrays = old
        .state()
        .into_iter()
        .map(|(name, numbers)| (name.into(), numbers.into()));
    let arrays: Vec<_> = arrays.collect();
    let saved = |arrays: &[_]| SavedState::from(arrays.to_vec());
    let mut new = table(Bootstrap::NextAction, 0.5);
    new.restore(8, &mut saved(&arrays)).unwrap();
    assert_eq!((&new.q, &new.pending, new.updates()), (&old.q, &old.pending, 8));
    assert!(new.restore(8, &mut saved(&arrays[1..])).is_err());
}

#[test]
fn after_a_round_that_was_cut_off_the_next_row_begins_a_new_one() {
    let saved = |table: &Tabular| {
        let arrays = table.state().into_iter();
        let arrays = arrays.map(|(name, numbers)| (name.to_owned(), numbers.to_vec()));
        SavedState::from(arrays.collect::<Vec<_>>())
    };
    let mut old = table(Bootstrap::NextAction, 0.5);
    teach(&mut old, 3, (0, 1, 4.0, 0.5, 1, false));
    let waiting = old.pending.clone();
    // A round has 8 rows: two actors with two environments each, two steps a chunk.
    let mut new = table(Bootstrap::NextAction, 0.5);
    new.restore(13, &mut saved(&old)).unwrap();
    let environments: Vec<usize> = (13..21).map(|row| new.environment(row)).collect();
    assert_eq!(environments, [0, 1, 0, 1, 2, 3, 2, 3]);
    assert!(new.pending.iter().all(|number| *number == 0.0));
    new.pending = waiting.clone();
    let mut newer = table(Bootstrap::NextAction, 0.5);
    newer.restore(29, &mut saved(&new)).unwrap();
    assert_eq!(
        (newer.environment(29), &newer.pending),
        (0, &waiting),
        "after whole rounds"
    );
    newer.restore(31, &mut saved(&new)).unwrap();
    assert_eq!(newer.environment(31), 0, "after another one that was cut off");
}

#[test]
fn continuous_observations_are_refused() {
    let pendulum = EnvironmentSpec {
        observation: Space::boxed(&[(-1.0, 1.0)]),
        ..lake(1, 2)
    };
    let refused = Tabular::new(
        Bootstrap::NextAction,
        &config::TabularConfig::default(),
        &pendulum,
        SIZES,
    );
    assert!(
        refused
            .unwrap_err()
            .to_string()
            .contains("it needs a discrete observation space")
    );
}
