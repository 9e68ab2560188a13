//! Evaluates a policy on the lake by its transition table.

use shoal_env_server::environment::frozen_lake::{LakeTransition, STATES, transitions};

/// The probability that a policy reaches the goal from the start within `steps` steps.
pub(crate) fn reaches_the_goal(policy: &[usize], steps: usize) -> f64 {
    let mut reached = [0.0; STATES];
    for _ in 0..steps {
        let one_more = |state| {
            let then = |o: LakeTransition| o.p * if o.terminated { o.reward } else { reached[o.next] };
            transitions(state, policy[state]).map(then).sum()
        };
        reached = std::array::from_fn(one_more);
    }
    reached[0]
}
