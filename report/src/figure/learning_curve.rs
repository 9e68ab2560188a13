//! Evaluation returns over environment steps, as in figures 4.8, 5.4, 5.6 and 5.8.

use std::path::Path;

use plotters::style::text_anchor::HPos;
use shoal_run::records::recorder::EvaluationRecord;

use super::canvas::{BLUE, px, save, text};
use super::panel::{Axis, Panel, Series, SeriesStyle, range_of};

const SIZE: (u32, u32) = (860, 470);

/// Most characters of a run's name in the title.
const NAME: usize = 48;

/// Draws the evaluations of `run`, which is trained by `algorithm`, as a thin line and their moving average as a thick
/// one.
pub fn learning_curve(
    (run, algorithm): (&str, &str),
    evaluations: &[EvaluationRecord],
    path: &Path,
) -> anyhow::Result<()> {
    let title = title(run, algorithm);
    let mut evaluations: Vec<&EvaluationRecord> = evaluations.iter().collect();
    evaluations.sort_by_key(|evaluation| evaluation.env_steps);
    let last = evaluations
        .last()
        .map_or(0, |evaluation| evaluation.env_steps)
        .max(1_000);
    let (unit, label) = unit_of(last);
    let raw: Vec<_> = evaluations
        .iter()
        .map(|e| (e.env_steps as f64 / unit, e.return_mean))
        .collect();
    let averaged_points = averaged_points(raw.len());
    let smoothed = smooth(&raw, averaged_points);

    let raw_label = match evaluations.last() {
        Some(evaluation) => format!("mean return of {} episodes", evaluation.episodes),
        None => String::new(),
    };
    let smoothed_label = format!("moving average of {averaged_points} evaluations, centred");
    let x = Axis::new(label, 0.0..last as f64 / unit);
    let y = Axis::new("evaluation return", range_of(raw.iter().map(|(_, y)| *y)));
    let mut series = Vec::new();
    if raw.len() <= 100 {
        series.push(Series {
            style: SeriesStyle::Dots,
            opacity: 0.6,
            width: 2.5,
            ..Series::line("", BLUE, raw.clone())
        });
    }
    let empty = raw.is_empty();
    series.push(Series {
        opacity: 0.5,
        width: 1.0,
        ..Series::line(&raw_label, BLUE, raw)
    });
    if averaged_points > 1 {
        series.push(Series {
            width: 3.0,
            ..Series::line(&smoothed_label, BLUE, smoothed)
        });
    }

    save(path, SIZE, |sheet| {
        Panel::new(&title, x, y, series).draw(sheet)?;
        if empty {
            let middle = (px(f64::from(SIZE.0) / 2.0), px(f64::from(SIZE.1) / 2.0));
            sheet.draw_text("no evaluation yet", &text(15.0, HPos::Center), middle)?;
        }
        Ok(())
    })
}

/// The title of a run's curve. A long name is cut in its middle, and control characters, which SVG cannot have, become
/// spaces.
fn title(run: &str, algorithm: &str) -> String {
    let run: Vec<char> = run.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    let name: String = match run.len() {
        0..=NAME => run.iter().collect(),
        long => {
            let (start, end) = (&run[..NAME / 2], &run[long - NAME / 2..]);
            start.iter().chain(&['…']).chain(end).collect()
        }
    };
    format!("{name}: learning curve of {algorithm}")
}

/// The divisor and the label of an axis of environment steps that ends at `last`.
pub(super) fn unit_of(last: u64) -> (f64, &'static str) {
    match last {
        0..20_000 => (1.0, "environment steps"),
        20_000..20_000_000 => (1e3, "environment steps (thousands)"),
        _ => (1e6, "environment steps (millions)"),
    }
}

/// Number of evaluations in the moving average: about a twelfth of them, always odd, and 1 (no smoothing) if there are
/// few.
fn averaged_points(evaluations: usize) -> usize {
    match evaluations {
        0..5 => 1,
        _ => (evaluations / 12).clamp(3, 101) | 1,
    }
}

/// The mean of the `averaged_points` points centred on each point; near the ends, of the points that exist.
fn smooth(points: &[(f64, f64)], averaged_points: usize) -> Vec<(f64, f64)> {
    let half = averaged_points / 2;
    let mean = |of: &[(f64, f64)]| of.iter().map(|(_, y)| y).sum::<f64>() / of.len() as f64;
    let around = |i: usize| &points[i.saturating_sub(half)..(i + half + 1).min(points.len())];
    points
        .iter()
        .enumerate()
        .map(|(i, (x, _))| (*x, mean(around(i))))
        .collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn evaluations(count: u64) -> Vec<EvaluationRecord> {
        (0..count)
            .map(|i| {
                let t = i as f64 / count as f64;
                let noise = ((i * 7919 % 1009) as f64 / 1009.0 - 0.5) * 250.0;
                let return_mean = -150.0 - 1300.0 * (1.0 - 1.0 / (1.0 + (-(t - 0.25) * 25.0).exp())) + noise;
                EvaluationRecord {
                    env_steps: i * 2_000,
                    return_mean,
                    episodes: 10,
                    ..EvaluationRecord::default()
                }
            })
            .collect()
    }

    #[test]
    fn any_number_of_evaluations_can_be_drawn() {
        let dir = tempfile::tempdir().unwrap();
        for count in [0, 1, 2, 5, 60, 400, 5_000] {
            let path = dir.path().join(format!("learning-curve-{count}.svg"));
            learning_curve(("run", "ddpg"), &evaluations(count), &path).unwrap();
            let svg = std::fs::read_to_string(&path).unwrap();
            assert!(svg.contains("environment steps") && svg.contains("evaluation return"));
            assert_eq!(svg.contains("moving average"), count >= 5, "{count}");
            assert_eq!(svg.contains("no evaluation yet"), count == 0, "{count}");
        }
    }

    #[test]
    fn the_title_names_run_and_algorithm() {
        assert_eq!(title("pendulum-1", "sac"), "pendulum-1: learning curve of sac");
        let long = title(&format!("{}\n{}", "a".repeat(60), "b".repeat(60)), "sac");
        assert_eq!(
            long,
            format!("{}…{}: learning curve of sac", "a".repeat(24), "b".repeat(24))
        );
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("curve.svg");
        learning_curve(("tau<0.1 & \u{1}b", "ddpg"), &evaluations(5), &path).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        assert!(svg.contains("tau&lt;0.1 &amp;  b: learning curve of ddpg"), "{svg}");
    }

    #[test]
    fn the_average_is_centred_and_shorter_at_the_ends() {
        let points = [(0.0, 1.0), (1.0, 2.0), (2.0, 6.0), (3.0, 1.0)];
        assert_eq!(smooth(&points, 3), [(0.0, 1.5), (1.0, 3.0), (2.0, 3.0), (3.0, 3.5)]);
        assert_eq!(smooth(&points, 1), points);
        assert!((0..10_000).all(|n| averaged_points(n) % 2 == 1 && averaged_points(n) <= n.max(1)));
    }

    #[test]
    fn values_that_are_not_numbers_are_left_out() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("curve.svg");
        let mut evaluations = evaluations(20);
        evaluations[3].return_mean = f64::NAN;
        learning_curve(("run", "ddpg"), &evaluations, &path).unwrap();
        assert!(!std::fs::read_to_string(path).unwrap().contains("NaN"));
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 150, failure_persistence: None, ..ProptestConfig::default() })]

        /// `evaluations.csv` may contain any numbers.
        #[test]
        fn any_numbers_can_be_drawn(
            numbers in prop::collection::vec((
                prop_oneof![0..9_u64, any::<u64>()],
                prop_oneof![
                    any::<f64>(),
                    prop::num::f64::ANY,
                    prop::sample::select(vec![f64::MAX, f64::MIN, f64::INFINITY, f64::NAN, 5e-324, 0.0, 1e15, 1.0 + f64::EPSILON, 1.0]),
                ],
            ), 0..12),
        ) {
            let directory = tempfile::tempdir().unwrap();
            let evaluations: Vec<_> = numbers
                .into_iter()
                .map(|(env_steps, return_mean)| EvaluationRecord { env_steps, return_mean, ..EvaluationRecord::default() })
                .collect();
            learning_curve(("run", "ddpg"), &evaluations, &directory.path().join("curve.svg")).unwrap();
        }
    }
}
