//! What is best on the lake, by its transition table.

use shoal_env_server::environment::frozen_lake::{ACTIONS, Outcome, STATES, transitions};

/// Bellman's optimality equation, iterated until nothing changes by 1e-12.
pub(crate) fn value_iteration(gamma: f64) -> [[f64; ACTIONS]; STATES] {
    let mut q = [[0.0; ACTIONS]; STATES];
    loop {
        let v = q.map(|values| values.into_iter().fold(f64::NEG_INFINITY, f64::max));
        let backup = |o: Outcome| o.p * (o.reward + if o.terminated { 0.0 } else { gamma * v[o.next] });
        let mut change: f64 = 0.0;
        for (state, values) in q.iter_mut().enumerate() {
            for (action, value) in values.iter_mut().enumerate() {
                let next: f64 = transitions(state, action).map(backup).sum();
                change = change.max((next - *value).abs());
                *value = next;
            }
        }
        if change < 1e-12 {
            return q;
        }
    }
}

/// How likely a policy is to reach the goal from the start within so many steps.
pub(crate) fn reaches_the_goal(policy: &[usize], steps: usize) -> f64 {
    let mut reached = [0.0; STATES];
    for _ in 0..steps {
        let one_more = |state| {
            let then = |o: Outcome| o.p * if o.terminated { o.reward } else { reached[o.next] };
            transitions(state, policy[state]).map(then).sum()
        };
        reached = std::array::from_fn(one_more);
    }
    reached[0]
}
