//! Optimal values of the frozen lake, computed from its transition table.

use shoal_env_server::environment::frozen_lake::{ACTIONS, LakeTransition, STATES, transitions};

/// Iterates Bellman's optimality equation until no value changes by 1e-12.
pub(crate) fn optimal_values(gamma: f64) -> [[f64; ACTIONS]; STATES] {
    let mut q = [[0.0; ACTIONS]; STATES];
    loop {
        let v = q.map(|values| values.into_iter().fold(f64::NEG_INFINITY, f64::max));
        let backup = |o: LakeTransition| o.p * (o.reward + if o.terminated { 0.0 } else { gamma * v[o.next] });
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
