//! The slippery lake: the exact value of a policy and the optimal values, computed from the transition table.

use serde::{Deserialize, Serialize};
use shoal_common::policy::argmax;
use shoal_env_server::environment::frozen_lake::{ACTIONS, STATES, transitions};

/// Steps after which an evaluation episode ends.
pub const LIMIT: u32 = 100;

/// Values closer to each other than this count as equal; it covers rounding errors.
const TIE: f64 = 1e-9;

/// Action values by state and action.
pub type Values = [[f64; ACTIONS]; STATES];

/// The expected result of an episode of at most [`LIMIT`] steps from the start.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ExpectedResult {
    /// Probability of reaching the goal.
    pub reached: f64,
    /// Expected number of steps to the goal, where an episode that does not reach it counts as [`LIMIT`].
    pub steps: f64,
}

impl ExpectedResult {
    /// Of the policy that takes this action in each state.
    pub fn of(policy: &[usize; STATES]) -> Self {
        let mut here = [0.0; STATES];
        here[0] = 1.0;
        let (mut reached, mut steps) = (0.0, 0.0);
        for step in 1..=LIMIT {
            let mut next = [0.0; STATES];
            for (state, p) in here.iter().enumerate().filter(|(_, p)| **p > 0.0) {
                for outcome in transitions(state, policy[state]) {
                    let p = p * outcome.p;
                    if outcome.reward > 0.0 {
                        reached += p;
                        steps += p * f64::from(step);
                    } else if !outcome.terminated {
                        next[outcome.next] += p;
                    }
                }
            }
            here = next;
        }
        Self {
            reached,
            steps: steps + (1.0 - reached) * f64::from(LIMIT),
        }
    }
}

impl ExpectedResult {
    /// Rounded to four decimals, enough for a figure.
    pub fn rounded(self) -> Self {
        let round = |value: f64| (1e4 * value).round() / 1e4;
        Self {
            reached: round(self.reached),
            steps: round(self.steps),
        }
    }
}

/// The action with the highest value in each state; among equal values the first.
pub fn greedy(table: &[f32]) -> [usize; STATES] {
    std::array::from_fn(|state| argmax(&table[state * ACTIONS..][..ACTIONS]))
}

/// q*, by value iteration.
pub fn optimal(gamma: f64) -> Values {
    let mut q: Values = [[0.0; ACTIONS]; STATES];
    loop {
        let best = |state: usize| q[state].iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let value = |state, action| -> f64 {
            let outcomes = transitions(state, action);
            outcomes
                .map(|outcome| {
                    let next = if outcome.terminated { 0.0 } else { best(outcome.next) };
                    outcome.p * (outcome.reward + gamma * next)
                })
                .sum()
        };
        let improved: Values = std::array::from_fn(|state| std::array::from_fn(|action| value(state, action)));
        let changes = improved.iter().flatten().zip(q.iter().flatten());
        let change = changes.map(|(new, old)| (new - old).abs()).fold(0.0, f64::max);
        q = improved;
        if change < 1e-14 {
            return q;
        }
    }
}

/// States in which the policy's action is not one of the best.
pub fn suboptimal_states(policy: &[usize; STATES], q_star: &Values) -> Vec<usize> {
    let best = |state: usize| q_star[state].iter().copied().fold(f64::NEG_INFINITY, f64::max);
    (0..STATES)
        .filter(|state| q_star[*state][policy[*state]] < best(*state) - TIE)
        .collect()
}

/// States in which the policy's action may lead into a hole.
pub fn risky_states(policy: &[usize; STATES]) -> Vec<usize> {
    let falls = |state: &usize| {
        // Holes and the goal have one outcome: staying.
        let mut outcomes = transitions(*state, policy[*state]);
        outcomes.any(|outcome| outcome.terminated && outcome.reward == 0.0 && outcome.next != *state)
    };
    (0..STATES).filter(falls).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An optimal policy; among equally good actions it takes the first.
    fn best() -> [usize; STATES] {
        let table: Vec<f32> = optimal(0.999).iter().flatten().map(|q| *q as f32).collect();
        greedy(&table)
    }

    #[test]
    fn the_optimal_policy_makes_no_mistakes_and_reaches_the_goal_three_times_in_four() {
        let q_star = optimal(0.999);
        assert!((q_star[0].iter().copied().fold(0.0, f64::max) - 0.785_53).abs() < 1e-4);
        let policy = best();
        assert!(suboptimal_states(&policy, &q_star).is_empty());
        let result = ExpectedResult::of(&policy);
        assert!((result.reached - 0.74).abs() < 0.01, "{result:?}");
        assert!((40.0..60.0).contains(&result.steps), "{result:?}");
        assert_eq!(risky_states(&policy), [6], "as the thesis has it");
    }

    #[test]
    fn a_bad_policy_has_suboptimal_and_risky_states() {
        let left = [0; STATES];
        assert_eq!(
            ExpectedResult::of(&left),
            ExpectedResult {
                reached: 0.0,
                steps: 100.0
            }
        );
        assert!(suboptimal_states(&left, &optimal(0.999)).contains(&1));
        assert!(risky_states(&[1; STATES]).contains(&1));
    }
}
