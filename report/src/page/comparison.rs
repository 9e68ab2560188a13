//! Comparison of runs: one diagram for each environment; repetitions also get their median and spread.

use serde::Serialize;
use shoal_run::records::recorder::EvaluationRecord;

use super::numbers::short;
use super::run::Run;
use super::settings::{Setting, in_common};
use crate::figure::quantile;

/// Number of x values at which repetitions are compared.
const X_VALUES: usize = 200;

/// At most this many differing settings are named in the label of a set.
const LABEL_SETTINGS: usize = 3;

/// The runs of one environment.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Comparison {
    pub(super) environment: String,
    pub(super) sets: Vec<RepeatedRuns>,
}

/// Runs with the same settings, that is, repetitions.
#[derive(Clone, Debug, Serialize)]
pub(super) struct RepeatedRuns {
    pub(super) label: String,
    /// The indices of the runs in the report.
    pub(super) runs: Vec<usize>,
    /// Over environment steps and over seconds, in the range that all runs cover. `None` for a single run.
    pub(super) by_steps: Option<Spread>,
    pub(super) by_time: Option<Spread>,
}

/// The median of several curves, and a band around it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Spread {
    /// What the band covers.
    pub(super) band: &'static str,
    pub(super) x: Vec<f64>,
    pub(super) low: Vec<f64>,
    pub(super) median: Vec<f64>,
    pub(super) high: Vec<f64>,
}

/// Groups the runs by environment and settings. Groups and runs keep the order of `runs`.
pub(super) fn compare(runs: &[Run]) -> Vec<Comparison> {
    let mut comparisons: Vec<Comparison> = Vec::new();
    for (i, run) in runs.iter().enumerate() {
        let of_environment = comparisons
            .iter()
            .position(|found| found.environment == run.environment);
        let comparison = of_environment.unwrap_or_else(|| {
            let environment = run.environment.clone();
            comparisons.push(Comparison {
                environment,
                sets: Vec::new(),
            });
            comparisons.len() - 1
        });
        let sets = &mut comparisons[comparison].sets;
        let alike = |set: &&mut RepeatedRuns| in_common(&runs[set.runs[0]].settings).eq(in_common(&run.settings));
        match sets.iter_mut().find(alike) {
            Some(set) => set.runs.push(i),
            None => sets.push(RepeatedRuns {
                label: String::new(),
                runs: vec![i],
                by_steps: None,
                by_time: None,
            }),
        }
    }
    for comparison in &mut comparisons {
        let labels: Vec<String> = (0..comparison.sets.len())
            .map(|i| label(&comparison.sets, i, runs))
            .collect();
        for (set, label) in comparison.sets.iter_mut().zip(labels) {
            set.label = label;
            let curves = |x: fn(&EvaluationRecord) -> f64| -> Vec<Vec<(f64, f64)>> {
                set.runs
                    .iter()
                    .map(|i| curve(&runs[*i].evaluation_records, x))
                    .collect()
            };
            set.by_steps = spread(&curves(|row| row.env_steps as f64));
            set.by_time = spread(&curves(|row| row.wall_seconds));
        }
    }
    comparisons
}

/// The name of a single run; otherwise the number of runs, their algorithm, and the settings in which they differ from
/// the other sets.
fn label(sets: &[RepeatedRuns], i: usize, runs: &[Run]) -> String {
    let first = |set: &RepeatedRuns| &runs[set.runs[0]];
    let set = &sets[i];
    if set.runs.len() == 1 {
        return first(set).name.clone();
    }
    let mut label = format!("{} runs of {}", set.runs.len(), first(set).algorithm);
    for setting in own_settings(sets, i, runs) {
        label += &format!(", {setting}");
    }
    label
}

/// The settings in which a set differs from the others, but no more than a few.
pub(super) fn own_settings(sets: &[RepeatedRuns], i: usize, runs: &[Run]) -> Vec<String> {
    let first = |set: &RepeatedRuns| &runs[set.runs[0]];
    let differs = |(key, value): &&Setting| {
        sets.iter().any(|other| {
            let there = first(other).settings.iter().find(|(name, _)| name == key);
            there.is_none_or(|(_, there)| there != value)
        })
    };
    let own = in_common(&first(&sets[i]).settings)
        .filter(differs)
        .take(LABEL_SETTINGS);
    own.map(|(key, value)| format!("{key} = {value}")).collect()
}

/// (x, mean return), sorted by x.
fn curve(rows: &[EvaluationRecord], x: fn(&EvaluationRecord) -> f64) -> Vec<(f64, f64)> {
    let points = rows.iter().map(|row| (x(row), row.return_mean));
    let mut curve: Vec<_> = points.filter(|(x, y)| x.is_finite() && y.is_finite()).collect();
    curve.sort_by(|a, b| a.0.total_cmp(&b.0));
    curve
}

/// The spread of the curves in the range that all of them cover; `None` for fewer than two curves or an empty range.
fn spread(curves: &[Vec<(f64, f64)>]) -> Option<Spread> {
    if curves.len() < 2 {
        return None;
    }
    let (mut from, mut to) = (f64::NEG_INFINITY, f64::INFINITY);
    for curve in curves {
        from = from.max(curve.first()?.0);
        to = to.min(curve.last()?.0);
    }
    if from >= to {
        return None;
    }
    // The quartiles of two or three values are close to their minimum and maximum.
    let (band, low, high) = match curves.len() {
        2 | 3 => ("minimum to maximum", 0.0, 1.0),
        _ => ("middle half", 0.25, 0.75),
    };
    let mut spread = Spread {
        band,
        x: Vec::new(),
        low: Vec::new(),
        median: Vec::new(),
        high: Vec::new(),
    };
    for i in 0..X_VALUES {
        let x = from + (to - from) * i as f64 / (X_VALUES - 1) as f64;
        let mut values: Vec<f64> = curves.iter().map(|curve| at(curve, x)).collect();
        values.sort_by(f64::total_cmp);
        spread.x.push(short(x));
        for (into, share) in [
            (&mut spread.low, low),
            (&mut spread.median, 0.5),
            (&mut spread.high, high),
        ] {
            into.push(short(quantile(&values, share)));
        }
    }
    Some(spread)
}

/// The curve's value at `x`, interpolated linearly.
fn at(curve: &[(f64, f64)], x: f64) -> f64 {
    let after = curve.partition_point(|(before, _)| *before <= x).min(curve.len() - 1);
    let (left, right) = (curve[after.saturating_sub(1)], curve[after]);
    if right.0 <= left.0 {
        return right.1;
    }
    let share = ((x - left.0) / (right.0 - left.0)).clamp(0.0, 1.0);
    left.1 + share * (right.1 - left.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_are_compared_in_the_range_that_all_cover() {
        let long = vec![(0.0, 0.0), (100.0, 100.0), (200.0, 0.0)];
        let late = vec![(50.0, 10.0), (100.0, 10.0)];
        let spread = super::spread(&[long.clone(), late.clone()]).unwrap();
        assert_eq!((spread.x[0], spread.x[X_VALUES - 1]), (50.0, 100.0));
        assert_eq!((spread.low[0], spread.median[0], spread.high[0]), (10.0, 30.0, 50.0));
        assert_eq!(
            (
                spread.low[X_VALUES - 1],
                spread.median[X_VALUES - 1],
                spread.high[X_VALUES - 1]
            ),
            (10.0, 55.0, 100.0)
        );
        assert_eq!(super::spread(std::slice::from_ref(&long)), None);
        assert_eq!(super::spread(&[long, vec![]]), None, "a run that was never evaluated");
        assert_eq!(super::spread(&[late, vec![(300.0, 1.0), (400.0, 1.0)]]), None);
    }

    #[test]
    fn the_band_of_many_curves_is_their_middle_half() {
        let curves: Vec<_> = (0..5).map(|y| vec![(0.0, f64::from(y)), (1.0, f64::from(y))]).collect();
        let spread = spread(&curves).unwrap();
        assert_eq!((spread.low[7], spread.median[7], spread.high[7]), (1.0, 2.0, 3.0));
        assert_eq!(spread.band, "middle half");
    }
}
