//! The claims of section 4.1.

use shoal_run::evaluation::analysis::lake::{ExpectedResult, Values, greedy, risky_states, suboptimal_states};

use super::super::claim::{Claim, spread};
use super::super::result::SeedResult;
use super::{EPISODES, Measurements, SettingResults};

/// Probabilities of reaching the goal count as equal if they differ by less than this.
const SAME: f64 = 0.05;

pub(super) fn all(
    epsilon: &[SettingResults<'_>; 3],
    alpha: &[SettingResults<'_>; 4],
    sarsa: &[SeedResult<Measurements>],
    q_star: &Values,
    best: ExpectedResult,
) -> Vec<Claim> {
    let [low, (_, chosen), high] = *epsilon;
    vec![
        optimal(chosen, q_star),
        slow(epsilon, best),
        early(low.1, chosen, high.1),
        late(chosen, high.1, q_star),
        state_six(chosen),
        alike(chosen, q_star),
        learning_rates(alpha),
        on_policy(chosen, sarsa, q_star),
    ]
}

/// The probability of reaching the goal between two episodes, as mean over the seeds; NaN without seeds.
fn reached(seeds: &[SeedResult<Measurements>], from: u64, to: u64) -> f64 {
    mean(seeds, |measurements| measurements.reached(from, to))
}

/// The mean over the seeds; NaN without seeds.
fn mean(seeds: &[SeedResult<Measurements>], of: impl Fn(&Measurements) -> f64) -> f64 {
    seeds.iter().map(|seed| of(&seed.measurements)).sum::<f64>() / seeds.len() as f64
}

/// Formats a mean, or "no results" for NaN.
fn format_mean(mean: f64, decimals: usize) -> String {
    if mean.is_nan() {
        return "no results".into();
    }
    format!("{mean:.decimals$}")
}

fn at_end(seeds: &[SeedResult<Measurements>]) -> f64 {
    reached(seeds, EPISODES - 1_000, EPISODES)
}

fn optimal(chosen: &[SeedResult<Measurements>], q_star: &Values) -> Claim {
    let wrong: Vec<Vec<usize>> = chosen
        .iter()
        .map(|seed| suboptimal_states(&greedy(&seed.measurements.q), q_star))
        .collect();
    let right = wrong.iter().filter(|states| states.is_empty()).count();
    let mut where_wrong: Vec<String> = wrong.iter().flatten().map(usize::to_string).collect();
    where_wrong.sort_by_key(|state| state.parse::<usize>().unwrap_or(0));
    let elsewhere = match where_wrong.as_slice() {
        [] => String::new(),
        states => format!("; states with another action: {}", states.join(", ")),
    };
    Claim::together(
        "The optimal policy is learned with the good setting (ε = 0.4, α = 0.03)",
        "with at least 9 of 10 seeds, the greedy policy takes an optimal action (by value iteration) in every state",
        format!("{right} of {} seeds{elsewhere}", chosen.len()),
        (!chosen.is_empty()).then_some(10 * right >= 9 * chosen.len()),
    )
}

fn slow(epsilon: &[SettingResults<'_>; 3], best: ExpectedResult) -> Claim {
    let ends = epsilon.map(|(label, seeds)| (label, at_end(seeds)));
    let have_results = epsilon.iter().all(|(_, seeds)| !seeds.is_empty());
    Claim::together(
        "The lowest ε of 0.1 does not converge within the 10,000 episodes",
        "over the last 1,000 episodes, the mean probability of reaching the goal is more than 0.05 below the optimal \
         policy's for ε = 0.1, and not for the other two",
        ends.map(|(label, end)| format!("{label}: {}", format_mean(end, 2)))
            .join("; "),
        have_results.then(|| {
            let converged = ends.map(|(_, end)| end > best.reached - SAME);
            converged == [false, true, true]
        }),
    )
}

fn early(
    low: &[SeedResult<Measurements>],
    chosen: &[SeedResult<Measurements>],
    high: &[SeedResult<Measurements>],
) -> Claim {
    let [low_mean, middle, high_mean] = [low, chosen, high].map(|seeds| reached(seeds, 500, 2_000));
    Claim::together(
        "ε = 0.7 looks as though it will be the best exploration rate early on",
        "between episodes 500 and 2,000, its mean probability of reaching the goal is the highest",
        format!(
            "0.1: {}; 0.4: {}; 0.7: {}",
            format_mean(low_mean, 3),
            format_mean(middle, 3),
            format_mean(high_mean, 3)
        ),
        (!low.is_empty() && !chosen.is_empty() && !high.is_empty())
            .then_some(high_mean > middle && high_mean > low_mean),
    )
}

fn late(chosen: &[SeedResult<Measurements>], high: &[SeedResult<Measurements>], q_star: &Values) -> Claim {
    let [middle, high_mean] = [chosen, high].map(|seeds| reached(seeds, 5_000, 8_000));
    let start = |seeds: &[SeedResult<Measurements>]| {
        let values = seeds.iter().map(|seed| highest(&seed.measurements, 0));
        spread(values, 2)
    };
    Claim::together(
        "ε = 0.7 is surpassed by ε = 0.4",
        "between episodes 5,000 and 8,000, the mean probability of reaching the goal is higher with ε = 0.4",
        format!(
            "0.4: {}; 0.7: {}; learned values of the start state at the end (q* is {:.3}): {} and {}",
            format_mean(middle, 3),
            format_mean(high_mean, 3),
            q_star[0].iter().copied().fold(f64::NEG_INFINITY, f64::max),
            start(chosen),
            start(high)
        ),
        (!chosen.is_empty() && !high.is_empty()).then_some(middle > high_mean),
    )
}

fn highest(measurements: &Measurements, state: usize) -> f64 {
    measurements.q[4 * state..][..4]
        .iter()
        .map(|q| f64::from(*q))
        .fold(f64::NEG_INFINITY, f64::max)
}

fn state_six(chosen: &[SeedResult<Measurements>]) -> Claim {
    let frozen = [0, 1, 2, 3, 4, 6, 8, 9, 10, 13, 14];
    let lowest = |seed: &SeedResult<Measurements>| {
        let by_value =
            |a: &&usize, b: &&usize| highest(&seed.measurements, **a).total_cmp(&highest(&seed.measurements, **b));
        frozen.iter().min_by(by_value).copied()
    };
    let dangerous = |seed: &SeedResult<Measurements>| risky_states(&greedy(&seed.measurements.q)) == [6];
    let count = |holds: &dyn Fn(&SeedResult<Measurements>) -> bool| chosen.iter().filter(|seed| holds(seed)).count();
    Claim::each_seed(
        "Following the policy, the only state with any possibility of falling into a hole is state 6, and its \
         Q-values are the lowest of all",
        "both are true",
        format!(
            "of {} seeds, state 6 alone is dangerous in {}, and has the lowest value in {}",
            chosen.len(),
            count(&dangerous),
            count(&|seed| lowest(seed) == Some(6))
        ),
        chosen.iter().map(|seed| dangerous(seed) && lowest(seed) == Some(6)),
    )
}

fn alike(chosen: &[SeedResult<Measurements>], q_star: &Values) -> Claim {
    let difference = |seed: &SeedResult<Measurements>| {
        f64::from((seed.measurements.q[4 * 6] - seed.measurements.q[4 * 6 + 2]).abs())
    };
    let [left, right] = [0, 2].map(|action| mean(chosen, |measurements| f64::from(measurements.q[4 * 6 + action])));
    Claim::together(
        "q*(6, left) = q*(6, right); the learned Q is only close to optimal",
        "the means of the two over the seeds differ by less than 0.1",
        format!(
            "means: left {}, right {} (q*: both {:.3}); difference within a seed: {}",
            format_mean(left, 3),
            format_mean(right, 3),
            q_star[6][0],
            spread(chosen.iter().map(difference), 2)
        ),
        (!chosen.is_empty()).then_some((left - right).abs() < 0.1),
    )
}

fn learning_rates(alpha: &[SettingResults<'_>; 4]) -> Claim {
    let ends = alpha.map(|(label, seeds)| (label, at_end(seeds)));
    let have_results = alpha.iter().all(|(_, seeds)| !seeds.is_empty());
    Claim::together(
        "A low learning rate leads to slow convergence, a high one may not converge; α = 0.03 is appropriate",
        "over the last 1,000 episodes, the mean probability of reaching the goal is highest with α = 0.03, and more \
         than 0.05 higher than with 0.01 and 0.3",
        ends.map(|(label, end)| format!("{label}: {}", format_mean(end, 2)))
            .join("; "),
        have_results.then(|| {
            let [low, chosen, middle, high] = ends.map(|(_, end)| end);
            chosen > middle && chosen - low > SAME && chosen - high > SAME
        }),
    )
}

fn on_policy(chosen: &[SeedResult<Measurements>], sarsa: &[SeedResult<Measurements>], q_star: &Values) -> Claim {
    let best = q_star[0].iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let [off, on] = [chosen, sarsa].map(|seeds| mean(seeds, |measurements| highest(measurements, 0)));
    Claim::together(
        "Q-learning approximates q* directly, without depending on the policy being followed; SARSA estimates the \
         value of the policy that explores (section 3.3.2)",
        "with the same ε and α, the learned value of the start state is nearer to q* with Q-learning, and below half \
         of q* with SARSA",
        format!(
            "Q-learning {}, SARSA {}, q* {best:.2}",
            format_mean(off, 2),
            format_mean(on, 2)
        ),
        (!chosen.is_empty() && !sarsa.is_empty()).then_some((best - off).abs() < (best - on).abs() && on < best / 2.0),
    )
}

#[cfg(test)]
mod tests {
    use super::super::super::result::tests::result;
    use super::super::{EXPERIMENTS, PolicySnapshot};
    use super::*;
    use shoal_run::evaluation::analysis::lake;

    /// A seed with these (episodes, probability of reaching the goal) during training, and these action-values at the
    /// end.
    fn seed(number: u64, rises: &[(u64, f64)], q: &Values) -> SeedResult<Measurements> {
        let evaluated = rises.iter().map(|(episodes, reached)| PolicySnapshot {
            episodes: *episodes,
            exact: ExpectedResult {
                reached: *reached,
                steps: 50.0,
            },
        });
        let measurements = Measurements {
            q: q.iter().flatten().map(|q| *q as f32).collect(),
            evaluated: evaluated.collect(),
        };
        result(&EXPERIMENTS[0], number, 0.7, measurements)
    }

    #[test]
    fn claims_hold_for_results_like_the_thesis_and_fail_for_the_opposite() {
        let q_star = lake::optimal(0.999);
        let best = ExpectedResult {
            reached: 0.74,
            steps: 50.0,
        };
        let half = q_star.map(|state| state.map(|q| 0.4 * q));
        let of = |rises: &[(u64, f64)], q: &Values| vec![seed(1, rises, q), seed(2, rises, q)];
        let good = of(&[(0, 0.0), (1_000, 0.2), (5_000, 0.73)], &q_star);
        let slow = of(&[(0, 0.0), (5_000, 0.3)], &q_star);
        let quick = of(&[(0, 0.3), (5_000, 0.71)], &q_star);
        let (low, high) = (of(&[(0, 0.2)], &half), of(&[(0, 0.5)], &half));
        let epsilon = [("0.1", &slow[..]), ("0.4", &good[..]), ("0.7", &quick[..])];
        let alpha = [
            ("0.01", &low[..]),
            ("0.03", &good[..]),
            ("0.1", &quick[..]),
            ("0.3", &high[..]),
        ];
        let held = |claims: Vec<Claim>| -> Vec<bool> {
            claims
                .into_iter()
                .map(|claim| claim.held().iter().all(|held| *held) && !claim.held().is_empty())
                .collect()
        };
        assert_eq!(held(all(&epsilon, &alpha, &low, &q_star, best)), [true; 8]);

        // The opposite: the fast setting is slow, the policy is not optimal, and SARSA's values are better.
        let mut flat = q_star;
        flat[6] = [0.9, 0.0, 0.5, 0.0];
        flat[2] = [0.0, 1.0, 0.0, 0.0];
        let bad = of(&[(0, 0.5), (5_000, 0.2)], &flat);
        let epsilon = [("0.1", &quick[..]), ("0.4", &bad[..]), ("0.7", &slow[..])];
        let alpha = [
            ("0.01", &good[..]),
            ("0.03", &bad[..]),
            ("0.1", &low[..]),
            ("0.3", &high[..]),
        ];
        let mut wrong = held(all(&epsilon, &alpha, &good, &q_star, best));
        // Both have the same value of the start state.
        assert_eq!(wrong.pop(), Some(false));
        assert_eq!(wrong, [false; 7]);
        let nothing = [("", &[][..]); 3];
        assert!(
            all(&nothing, &[("", &[][..]); 4], &[], &q_star, best)
                .iter()
                .all(|claim| claim.held().is_empty())
        );
        assert!(
            early(&[], &good, &quick).held().is_empty(),
            "nothing is checked without the results of a setting"
        );
    }
}
