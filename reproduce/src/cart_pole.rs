//! CartPole (section 4.2): REINFORCE in the thesis's three variants, and with a baseline.

use rand::RngExt;
use serde::{Deserialize, Serialize};
use shoal_common::policy::Policy;
use shoal_common::stream::{Purpose, stream};
use shoal_report::figure::{self, CurvesOfSetting, DiagramAxes};

use super::claim::{Claim, median, percent, spread};
use super::experiment::{Experiment, Length, Milestone};
use super::family::{Family, Results, TrainedRun};
use super::report_section::{FigureWriter, ReportSection};
use super::result::SeedResult;

/// Number of episodes in the moving average of figure 4.6.
const SPAN: usize = 100;

/// The task is solved when the moving average reaches this return.
const SOLVED: f64 = 195.0;

/// After the task was solved, a moving average below this return is a drop in performance.
const DROPPED: f64 = 150.0;

/// A drop ends when the moving average exceeds this return.
const RECOVERED: f64 = 190.0;

/// Number of episodes between stored points of the curve.
const CURVE_INTERVAL: usize = 10;

const EPISODES: u64 = 5_000;

const PLAIN: &str = "cart-pole-plain";
const NORMALISED: &str = "cart-pole";
const SKIPPING: &str = "cart-pole-skip";
const BASELINE: &str = "cart-pole-baseline";

const VARIANTS: [(&str, &str); 4] = [
    (PLAIN, "plain"),
    (NORMALISED, "normalised"),
    (SKIPPING, "normalised, skipping the limit"),
    (BASELINE, "baseline"),
];

pub(super) const EXPERIMENTS: [Experiment; 4] = [
    experiment(PLAIN, &["reinforce.weight=return"]),
    experiment(NORMALISED, &[]),
    experiment(SKIPPING, &["reinforce.learn_at_limit=false"]),
    experiment(BASELINE, &["reinforce.weight=baseline"]),
];

const fn experiment(name: &'static str, settings: &'static [&'static str]) -> Experiment {
    Experiment {
        name,
        cli_name: "cart-pole",
        preset: "cart-pole",
        settings,
        quick: &["evaluation.every=500", "evaluation.final_episodes=10"],
        seeds: 10,
        milestones: &[Milestone {
            suffix: "",
            length: Length::Episodes(EPISODES),
            quick_length: Length::Episodes(60),
        }],
    }
}

/// What is stored of a training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct TrainingHistory {
    /// (episode, mean return of the last [`SPAN`] episodes), every [`CURVE_INTERVAL`] episodes.
    average: Vec<(u64, f64)>,
    /// The first episode at which the average over [`SPAN`] episodes was at least [`SOLVED`].
    solved: Option<u64>,
    /// How often the average fell below [`DROPPED`] after that. Between two drops it must have been above
    /// [`RECOVERED`].
    drops: u32,
    /// The share of the episodes from `solved` on at which the average was below [`DROPPED`].
    below: Option<f64>,
    /// Whether the last policy's scores are the same for all states, because all its ReLU units are dead.
    dead: bool,
}

impl TrainingHistory {
    fn of(returns: &[f64], dead: bool) -> Self {
        let averages: Vec<f64> = (1..=returns.len())
            .map(|end| {
                let last = &returns[end.saturating_sub(SPAN)..end];
                last.iter().sum::<f64>() / last.len() as f64
            })
            .collect();
        let first_complete = (SPAN - 1).min(averages.len());
        let solved = averages[first_complete..]
            .iter()
            .position(|it| *it >= SOLVED)
            .map(|at| at + first_complete);
        let after = solved.map_or(&[][..], |at| &averages[at..]);
        let (mut drops, mut high) = (0, true);
        for average in after {
            if high && *average < DROPPED {
                (drops, high) = (drops + 1, false);
            } else if *average > RECOVERED {
                high = true;
            }
        }
        let low = after.iter().filter(|it| **it < DROPPED).count();
        let curve = averages
            .iter()
            .enumerate()
            .skip(CURVE_INTERVAL - 1)
            .step_by(CURVE_INTERVAL);
        Self {
            average: curve
                .map(|(i, it)| (i as u64 + 1, (10.0 * it).round() / 10.0))
                .collect(),
            solved: solved.map(|at| at as u64 + 1),
            drops,
            below: solved.map(|_| low as f64 / after.len() as f64),
            dead,
        }
    }

    fn curve(&self) -> Vec<(f64, f64)> {
        self.average
            .iter()
            .map(|(episode, mean)| (*episode as f64, *mean))
            .collect()
    }

    /// Mean of the moving average after episode 1,000; `None` if the training is shorter.
    fn late(&self) -> Option<f64> {
        let late = self
            .average
            .iter()
            .filter(|(episode, _)| *episode > 1_000)
            .map(|(_, mean)| *mean);
        let values: Vec<f64> = late.collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    }
}

/// See [`EXPERIMENTS`].
pub(super) struct CartPole;

impl Family for CartPole {
    type Measurements = TrainingHistory;
    const EXPERIMENTS: &'static [Experiment] = &EXPERIMENTS;

    fn measure(trained: &TrainedRun, _: &Milestone) -> anyhow::Result<TrainingHistory> {
        let episodes = trained.episodes()?;
        let returns: Vec<f64> = episodes.iter().map(|episode| episode.episode_return).collect();
        Ok(TrainingHistory::of(&returns, is_dead(trained)?))
    }

    fn sections(results: &Results<TrainingHistory>, writer: &FigureWriter) -> anyhow::Result<Vec<ReportSection>> {
        let variants = VARIANTS.map(|(name, label)| (label, results.of(name, "")));
        let settings: Vec<CurvesOfSetting> = variants
            .iter()
            .map(|(label, seeds)| {
                let runs: Vec<_> = seeds.iter().map(|seed| seed.measurements.curve()).collect();
                CurvesOfSetting {
                    label: (*label).into(),
                    curve: figure::pointwise(&runs, median),
                    runs,
                }
            })
            .collect();
        let axes = DiagramAxes {
            title: "Moving average of the training returns, median over the seeds",
            x: ("episode", EPISODES as f64),
            y: ("return, mean of 100 episodes", 0.0, 210.0),
            level: Some(("solved: 195", SOLVED)),
        };
        let figures = vec![
            writer.add(
                "cart-pole-variants",
                "Reward history, moving average over 100 episodes: median over the seeds (figure 4.6, and the \
                 baseline)",
                |path| figure::lines(&axes, &settings, path),
            )?,
            writer.add(
                "cart-pole-seeds",
                "The same for every seed; the thesis shows a single run, which may be like any of these (figure 4.6)",
                |path| figure::lines_by_setting(&axes, &settings, path),
            )?,
        ];
        Ok(vec![ReportSection {
            title: "CartPole with REINFORCE (section 4.2)",
            from: EXPERIMENTS.iter().map(|experiment| (experiment.name, "")).collect(),
            remark: REMARK.into(),
            claims: claims(variants.map(|(_, seeds)| seeds)),
            figures,
        }])
    }
}

/// Markdown before the table of claims.
const REMARK: &str = "\
The environment is Gymnasium's: an episode ends when the pole is beyond ±12° or the cart beyond ±2.4. The thesis's text
gives the bounds of the observation instead, ±24° and ±4.8. An episode is collected with the policy that its update
starts from. Algorithm 3 was read as follows:

- There is no factor γᵗ, the loss is the mean over the episode's steps, and there is one step of Adam per episode.
- Weights are initialised as in TensorFlow: Glorot, biases zero.
- Normalised returns are (G − mean) / (standard deviation + 1e-8) over one episode, so equal returns have no effect.
- The baseline has two hidden layers of 32 units, and Adam's learning rate is 0.01.

A prototype decided between the readings, with 40 runs each; no command here repeats it. Only this reading gives plain
returns that fail and normalised returns that cross 195 near episode 800. The others contradict the thesis:

- With the sum instead of the mean, plain returns solve the task in three of four runs.
- With γᵗ, normalised returns cross 195 at episode 1,900 to 2,800, if at all.
- With a step of Adam at every time step, nothing is learned.

The second hidden layer has only two units. If both are dead from some episode on, the policy no longer depends on the
observation, and nothing more is learned. Such seeds are counted like the others.";

/// Whether the last policy has the same scores for many random states within the bounds of an episode.
fn is_dead(trained: &TrainedRun) -> anyhow::Result<bool> {
    const STATES: usize = 200;
    let Policy::Scored(mut scores) = trained.config.policy(STATES)? else {
        return Ok(false);
    };
    let mut numbers = stream(trained.config.run.seed, Purpose::Analysis, 0, 0);
    let bounds: [f32; 4] = [2.4, 2.0, 0.2, 2.0];
    let states: Vec<f32> = (0..STATES)
        .flat_map(|_| bounds.map(|bound| numbers.random_range(-bound..bound)))
        .collect();
    let mut each = scores.compute(&trained.last.parameters, &states);
    let first: Option<Vec<f32>> = each.next().map(Into::into);
    Ok(first.is_none_or(|first| each.all(|scores| scores == first)))
}

type Seeds<'a> = &'a [SeedResult<TrainingHistory>];

fn claims([plain, normalised, skipping, baseline]: [Seeds<'_>; 4]) -> Vec<Claim> {
    let solved = |seeds: Seeds<'_>| seeds.iter().filter_map(|seed| seed.measurements.solved).count();
    // The median first crossing of 195. A seed that never solves the task counts as infinitely late.
    let crossing = |seeds: Seeds<'_>| -> Option<f64> {
        let mut at: Vec<f64> = seeds
            .iter()
            .map(|seed| seed.measurements.solved.map_or(f64::INFINITY, |at| at as f64))
            .collect();
        at.sort_by(f64::total_cmp);
        (!at.is_empty()).then(|| median(&at))
    };
    let episode = |at: Option<f64>| match at {
        Some(at) if at.is_finite() => format!("{at:.0}"),
        _ => "never".into(),
    };
    let late = |seeds: Seeds<'_>| spread(seeds.iter().filter_map(|seed| seed.measurements.late()), 0);
    let dead = |seeds: Seeds<'_>| seeds.iter().filter(|seed| seed.measurements.dead).count();
    let below = |seeds: Seeds<'_>| -> Option<f64> {
        let shares: Vec<f64> = seeds.iter().filter_map(|seed| seed.measurements.below).collect();
        (!shares.is_empty()).then(|| shares.iter().sum::<f64>() / shares.len() as f64)
    };
    let drops = |seeds: Seeds<'_>| -> String {
        let each: Vec<f64> = seeds
            .iter()
            .filter(|seed| seed.measurements.solved.is_some())
            .map(|seed| f64::from(seed.measurements.drops))
            .collect();
        if each.is_empty() {
            return "—".into();
        }
        format!("{:.1}", each.iter().sum::<f64>() / each.len() as f64)
    };
    let share = |below: Option<f64>| below.map_or_else(|| "—".into(), percent);
    let solvers = || normalised.iter().filter(|seed| seed.measurements.solved.is_some());
    vec![
        Claim::each_seed(
            "Without normalisation the task is not even close to solved after 5,000 episodes",
            "the mean of 100 episodes never reaches 195",
            format!(
                "{} of {} seeds reach it; mean return after episode 1,000: {}; dead networks at the end: {}",
                solved(plain),
                plain.len(),
                late(plain),
                dead(plain)
            ),
            plain.iter().map(|seed| seed.measurements.solved.is_none()),
        ),
        Claim::together(
            "With normalisation the moving average crosses 195 at about episode 800",
            "the median first crossing over the seeds lies between episodes 400 and 1,200",
            format!(
                "median first crossing: {}; {} of {} seeds cross; dead networks at the end: {}",
                episode(crossing(normalised)),
                solved(normalised),
                normalised.len(),
                dead(normalised)
            ),
            crossing(normalised).map(|at| (400.0..=1_200.0).contains(&at)),
        ),
        Claim::each_seed(
            "Performance drops when training continues beyond this point",
            "after crossing 195, the average falls below 150 at least once",
            format!("{} times, in the mean over the seeds that cross", drops(normalised)),
            solvers().map(|seed| seed.measurements.drops > 0),
        ),
        Claim::together(
            "Not updating where the step limit ended the episode stabilises the training",
            "after the crossing, a smaller share of the episodes has an average below 150, in the mean over the seeds \
             that cross",
            format!(
                "share below 150: {} instead of {}; drops: {} instead of {}; {} of {} seeds cross, median {}",
                share(below(skipping)),
                share(below(normalised)),
                drops(skipping),
                drops(normalised),
                solved(skipping),
                skipping.len(),
                episode(crossing(skipping))
            ),
            below(skipping)
                .zip(below(normalised))
                .map(|(with, without)| with < without),
        ),
        Claim::together(
            "A baseline would reduce the variance, and could decrease the convergence time",
            "the median first crossing is earlier than with plain returns",
            format!(
                "median {} instead of {} (normalised: {}); {} of {} seeds cross; share below 150 after the crossing: \
                 {}",
                episode(crossing(baseline)),
                episode(crossing(plain)),
                episode(crossing(normalised)),
                solved(baseline),
                baseline.len(),
                share(below(baseline))
            ),
            crossing(baseline)
                .zip(crossing(plain))
                .map(|(with, without)| with < without),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::super::result::tests::result;
    use super::*;

    fn seed(number: u64, returns: &[f64]) -> SeedResult<TrainingHistory> {
        result(&EXPERIMENTS[0], number, 100.0, TrainingHistory::of(returns, false))
    }

    /// Returns of consecutive episodes: for each (count, value), `count` times `value`.
    fn history(parts: &[(usize, f64)]) -> Vec<f64> {
        parts.iter().flat_map(|(count, value)| vec![*value; *count]).collect()
    }

    #[test]
    fn solving_and_drops_are_found_in_a_history() {
        let returns = history(&[
            (500, 20.0),
            (400, 200.0),
            (200, 100.0),
            (300, 200.0),
            (150, 0.0),
            (450, 200.0),
        ]);
        let measurements = TrainingHistory::of(&returns, false);
        // The first mean of at least 195 has 98 episodes of 200 and 2 of 20.
        assert_eq!(measurements.solved, Some(598));
        assert_eq!(measurements.drops, 2);
        assert!(
            (0.2..0.5).contains(&measurements.below.unwrap()),
            "{:?}",
            measurements.below
        );
        assert_eq!((measurements.average.len(), measurements.average[0]), (200, (10, 20.0)));
        let never = TrainingHistory::of(&history(&[(600, 30.0)]), true);
        assert_eq!((never.solved, never.below, never.drops), (None, None, 0));
        assert_eq!(
            TrainingHistory::of(&history(&[(50, 200.0)]), false).solved,
            None,
            "fewer than 100 episodes do not count"
        );
    }

    #[test]
    fn claims_hold_for_results_like_the_thesis_and_fail_for_the_opposite() {
        let fails = history(&[(5_000, 20.0)]);
        let shaky = history(&[(750, 20.0), (1_000, 200.0), (1_000, 50.0), (2_250, 200.0)]);
        let steady = history(&[(700, 20.0), (4_300, 200.0)]);
        let late = history(&[(2_000, 20.0), (3_000, 200.0)]);
        let of = |returns: &[f64]| vec![seed(1, returns), seed(2, returns)];
        let [fails, shaky, steady, late] = [fails, shaky, steady, late].map(|returns| of(&returns));
        let held = |claims: Vec<Claim>| -> Vec<bool> {
            claims
                .into_iter()
                .map(|claim| claim.held().iter().all(|held| *held) && !claim.held().is_empty())
                .collect()
        };
        assert_eq!(held(claims([&fails, &shaky, &steady, &steady])), [true; 5]);
        assert_eq!(held(claims([&steady, &late, &shaky, &late])), [false; 5]);
        let nothing = claims([&[], &[], &[], &[]]);
        assert!(nothing.iter().all(|claim| claim.held().is_empty()));
        assert!(
            nothing[0].measured.contains("after episode 1,000: —;"),
            "{}",
            nothing[0].measured
        );
        assert!(nothing[2].measured.starts_with("— times"), "{}", nothing[2].measured);
        let short = of(&history(&[(60, 20.0)]));
        assert!(
            claims([&short, &short, &short, &short])[0]
                .measured
                .contains("after episode 1,000: —;"),
            "a training that is too short has no mean after episode 1,000"
        );
    }
}
