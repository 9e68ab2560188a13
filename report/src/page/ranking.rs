//! Which settings are best, and how certain that is: the results of repetitions with bootstrap intervals over their
//! seeds.

use serde::Serialize;

use super::comparison::{RepeatedRuns, own_settings};
use super::numbers::short;
use super::run::Run;
use crate::figure::quantile;

/// Resamples of a bootstrap.
const RESAMPLES: usize = 5_000;

/// With fewer runs, the intervals of a bootstrap are too narrow.
const FEW: usize = 5;

/// The share of the values that is left out on either side, as in an interquartile mean.
const TRIMMED: f64 = 0.25;

/// Each end of the interval leaves out this share of the resamples.
const TAIL: f64 = 0.025;

/// The settings of one environment's runs, the best first.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Ranking {
    pub(super) environment: String,
    pub(super) places: Vec<RankedSetting>,
    /// Which setting is best and how certain that is, in a sentence; `None` for a single one.
    pub(super) verdict: Option<String>,
}

/// The result of one setting.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct RankedSetting {
    pub(super) label: String,
    /// The number of its runs with a result.
    pub(super) runs: usize,
    /// How many of them have not finished: their result is their last evaluation.
    pub(super) unfinished: usize,
    /// The interquartile mean of their results: without the best and the worst quarter, if there are at least four.
    pub(super) mean: f64,
    /// Its 95 % interval by a bootstrap over the runs; `None` for fewer than two.
    pub(super) interval: Option<[f64; 2]>,
    /// The share of the resamples in which it is the best; `None` if a setting has fewer than two runs.
    pub(super) best: Option<f64>,
}

/// Ranks the sets of an environment's runs; `None` if there is nothing to compare or nothing was repeated.
pub(super) fn rank(environment: &str, sets: &[RepeatedRuns], runs: &[Run]) -> Option<Ranking> {
    let results: Vec<(String, usize, Vec<f64>)> = sets
        .iter()
        .enumerate()
        .filter_map(|(i, set)| {
            let found: Vec<(f64, bool)> = set.runs.iter().filter_map(|run| runs[*run].result()).collect();
            let values: Vec<f64> = found.iter().map(|(value, _)| *value).collect();
            let unfinished = found.iter().filter(|(_, finished)| !finished).count();
            let label = match own_settings(sets, i, runs).join(", ") {
                // A single set.
                none if none.is_empty() => runs[set.runs[0]].algorithm.to_owned(),
                own => own,
            };
            (!values.is_empty()).then_some((label, unfinished, values))
        })
        .collect();
    if !results.iter().any(|(.., values)| values.len() > 1) {
        return None;
    }
    // Settings that were trained to the end are not compared with settings that were ended early.
    let any_finished = results.iter().any(|(_, unfinished, _)| *unfinished == 0);
    let is_compared = |unfinished: usize| !any_finished || unfinished == 0;
    let (compared, rest): (Vec<_>, Vec<_>) = results.iter().partition(|(_, unfinished, _)| is_compared(*unfinished));
    let mut places = Vec::new();
    for (group, is_compared) in [(compared, true), (rest, false)] {
        let values: Vec<&[f64]> = group.iter().map(|(.., values)| values.as_slice()).collect();
        let mut of_group = Vec::new();
        for ((label, unfinished, values), (interval, best)) in group.iter().zip(bootstrap(&values)) {
            of_group.push(RankedSetting {
                label: label.clone(),
                runs: values.len(),
                unfinished: *unfinished,
                mean: short(trimmed_mean(values.clone())),
                interval,
                best: best.filter(|_| is_compared),
            });
        }
        of_group.sort_by(|a, b| b.mean.total_cmp(&a.mean));
        places.extend(of_group);
    }
    Some(Ranking {
        environment: environment.into(),
        verdict: verdict(&places),
        places,
    })
}

fn verdict(places: &[RankedSetting]) -> Option<String> {
    let [best, second, ..] = places else {
        return None;
    };
    if best.unfinished == 0 && second.unfinished > 0 {
        return Some(format!(
            "{} is the only setting that was trained to the end, so it is not compared with the others",
            best.label
        ));
    }
    let share = best.best?;
    let certainty = match share {
        0.975.. => "almost certainly the best",
        0.9.. => "probably the best",
        0.6.. => "perhaps the best",
        _ => "the best so far, but that may be chance",
    };
    let few = match places.iter().map(|place| place.runs).min() {
        Some(runs) if runs < FEW => format!("; {runs} runs per setting are not enough to be sure: train more seeds"),
        _ => String::new(),
    };
    let others = match places.iter().filter(|place| place.best.is_some()).count() {
        3.. if places.iter().any(|place| place.best.is_none()) => "all others that were trained to the end",
        3.. => "all others",
        _ => &second.label,
    };
    Some(format!(
        "{} is {certainty}, ahead of {others} in {:.0} % of the resamples{few}",
        best.label,
        100.0 * share
    ))
}

impl Ranking {
    /// A line for each setting.
    pub(super) fn lines(&self) -> impl Iterator<Item = String> {
        self.places.iter().map(|place| {
            let interval = place
                .interval
                .map_or_else(String::new, |[low, high]| format!(" [{low:.2}, {high:.2}]"));
            let unfinished = match place.unfinished {
                0 => String::new(),
                some => format!(", {some} not finished"),
            };
            let best = place
                .best
                .map_or_else(String::new, |share| format!(", best in {:.0} %", 100.0 * share));
            format!(
                "{}: {:.2}{interval}, {} {}{unfinished}{best}",
                place.label,
                place.mean,
                place.runs,
                if place.runs == 1 { "run" } else { "runs" }
            )
        })
    }
}

/// For each list of results the 95 % interval of its interquartile mean, and the share of the resamples in which that
/// is the highest. The lists are resampled independently of each other.
fn bootstrap(values: &[&[f64]]) -> Vec<(Option<[f64; 2]>, Option<f64>)> {
    // Always the same numbers, so that a report made again is the same.
    let mut random = SplitMix(1);
    let mut means: Vec<Vec<f64>> = vec![Vec::with_capacity(RESAMPLES); values.len()];
    let mut wins = vec![0.0; values.len()];
    for _ in 0..RESAMPLES {
        for (list, means) in values.iter().zip(&mut means) {
            let drawn = (0..list.len()).map(|_| list[random.below(list.len())]).collect();
            means.push(trimmed_mean(drawn));
        }
        let newest = || means.iter().filter_map(|of| of.last().copied());
        let highest = newest().fold(f64::NEG_INFINITY, f64::max);
        let winners = newest().filter(|mean| *mean >= highest).count();
        for (mean, wins) in newest().zip(&mut wins) {
            *wins += if mean >= highest { 1.0 / winners as f64 } else { 0.0 };
        }
    }
    let all_repeated = values.len() > 1 && values.iter().all(|list| list.len() > 1);
    let each = values.iter().zip(means).zip(wins);
    each.map(|((list, mut means), wins)| {
        means.sort_by(f64::total_cmp);
        let interval = (list.len() > 1).then(|| [TAIL, 1.0 - TAIL].map(|share| short(quantile(&means, share))));
        (interval, all_repeated.then(|| wins / RESAMPLES as f64))
    })
    .collect()
}

/// The mean without the lowest and the highest quarter.
fn trimmed_mean(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let cut = (values.len() as f64 * TRIMMED) as usize;
    let kept = &values[cut..values.len() - cut];
    kept.iter().sum::<f64>() / kept.len() as f64
}

/// Steele et al. 2014: a small generator, which is enough for resampling.
struct SplitMix(u64);

impl SplitMix {
    fn below(&mut self, count: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^= mixed >> 31;
        ((u128::from(mixed) * count as u128) >> 64) as usize
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_interquartile_mean_leaves_out_a_quarter_on_either_side() {
        assert_eq!(trimmed_mean(vec![3.0, 1.0, 2.0]), 2.0, "three are too few");
        assert_eq!(trimmed_mean(vec![100.0, 1.0, 3.0, -50.0]), 2.0);
        assert_eq!(trimmed_mean((0..8).map(f64::from).collect()), 3.5);
    }

    #[test]
    fn intervals_and_certainty_follow_from_the_results() {
        let (low, high) = ([1.0, 2.0, 3.0, 4.0, 5.0], [11.0, 12.0, 13.0, 14.0, 15.0]);
        let found = bootstrap(&[&low, &high]);
        assert_eq!((found[0].1, found[1].1), (Some(0.0), Some(1.0)));
        let [from, to] = found[0].0.unwrap();
        // By enumeration of all resamples: 1.33 and 4.67.
        assert!((from - 1.33).abs() < 0.35 && (to - 4.67).abs() < 0.35, "{from} {to}");
        let same = bootstrap(&[&low, &low]);
        assert!((same[0].1.unwrap() - 0.5).abs() < 0.03, "{same:?}");
        let place = |label: &str, mean, best| RankedSetting {
            label: label.into(),
            runs: 5,
            unfinished: 0,
            mean,
            interval: None,
            best,
        };
        let told = verdict(&[place("b", 13.0, found[1].1), place("a", 3.0, found[0].1)]);
        let expected = "b is almost certainly the best, ahead of a in 100 % of the resamples";
        assert_eq!(told.as_deref(), Some(expected));
        let halved = |best: Option<f64>| RankedSetting {
            unfinished: 5,
            ..place("ended early", 20.0, best)
        };
        let told = verdict(&[place("b", 13.0, Some(0.99)), place("a", 3.0, Some(0.01)), halved(None)]);
        assert!(
            told.unwrap().contains("ahead of a in 99 %"),
            "one that was ended early is not compared"
        );
        let told = verdict(&[place("b", 13.0, None), halved(None)]);
        assert!(
            told.unwrap()
                .starts_with("b is the only setting that was trained to the end")
        );
        let single = bootstrap(&[&[1.0], &low]);
        assert_eq!((single[0], single[1].1), ((None, None), None));
    }
}
