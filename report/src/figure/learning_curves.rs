//! The learning curves of several seeds in one diagram: thin lines, their median as a thick line, and the middle half
//! as a band.

use std::path::Path;

use super::canvas::{BLUE, INK, save};
use super::learning_curve::unit_of;
use super::lines::pointwise;
use super::panel::{Axis, Panel, Series, SeriesStyle, range_of};

const SIZE: (u32, u32) = (860, 470);

/// Draws one curve of (environment steps, mean return) for each seed. `mark` is a number of environment steps to be
/// marked by a vertical line, with the line's label.
pub fn learning_curves(
    title: &str,
    curves: &[Vec<(u64, f64)>],
    mark: Option<(u64, &str)>,
    path: &Path,
) -> anyhow::Result<()> {
    let last = curves.iter().flatten().map(|(steps, _)| *steps).max().unwrap_or(0);
    let (unit, label) = unit_of(last.max(1_000));
    let height = range_of(curves.iter().flatten().map(|(_, value)| *value));
    let scaled = |points: &mut dyn Iterator<Item = (u64, f64)>| -> Vec<(f64, f64)> {
        points.map(|(steps, value)| (steps as f64 / unit, value)).collect()
    };
    let mut series = Vec::new();
    let [lower, median, upper] = [0.25, 0.5, 0.75].map(|share| pointwise(curves, |sorted| quantile(sorted, share)));
    if curves.len() > 2 {
        let outline = &mut lower.iter().chain(upper.iter().rev()).copied();
        series.push(Series {
            style: SeriesStyle::Area,
            opacity: 0.18,
            ..Series::line("middle half", BLUE, scaled(outline))
        });
    }
    for (i, curve) in curves.iter().enumerate() {
        let label = if i == 0 { "each seed" } else { "" };
        let (opacity, width) = if curves.len() > 1 { (0.4, 0.9) } else { (1.0, 1.8) };
        series.push(Series {
            opacity,
            width,
            ..Series::line(label, BLUE, scaled(&mut curve.iter().copied()))
        });
    }
    if curves.len() > 1 {
        series.push(Series {
            width: 2.6,
            ..Series::line("median", BLUE, scaled(&mut median.iter().copied()))
        });
    }
    if let Some((steps, label)) = mark {
        let x = steps as f64 / unit;
        series.push(Series {
            opacity: 0.7,
            width: 1.0,
            ..Series::line(label, INK, vec![(x, height.start), (x, height.end)])
        });
    }
    let x = Axis::new(label, 0.0..last.max(1_000) as f64 / unit);
    let panel = Panel::new(title, x, Axis::new("evaluation return", height), series);
    save(path, SIZE, |sheet| panel.draw(sheet))
}

/// The quantile `share` (0 to 1) of sorted values, interpolated linearly. There must be at least one value.
pub fn quantile(sorted: &[f64], share: f64) -> f64 {
    let place = share * (sorted.len() - 1) as f64;
    let (below, above) = (sorted[place.floor() as usize], sorted[place.ceil() as usize]);
    below + (above - below) * place.fract()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_interpolated() {
        let values = [1.0, 2.0, 4.0, 8.0];
        assert_eq!(
            [0.0, 0.25, 0.5, 1.0].map(|share| quantile(&values, share)),
            [1.0, 1.75, 3.0, 8.0]
        );
        let curves = [vec![(10, 3.0), (20, 5.0)], vec![(10, 1.0)], vec![(10, 2.0), (20, 6.0)]];
        assert_eq!(pointwise(&curves, |sorted| quantile(sorted, 0.5)), [(10, 2.0)]);
    }

    #[test]
    fn any_number_of_seeds_can_be_drawn() {
        let dir = tempfile::tempdir().unwrap();
        for seeds in [0, 1, 2, 5] {
            let path = dir.path().join(format!("{seeds}.svg"));
            let curves: Vec<_> = (0..seeds)
                .map(|s| (1..20).map(|t| (t * 2_000, (t * s) as f64)).collect())
                .collect();
            learning_curves("Evaluations", &curves, Some((10_000, "here")), &path).unwrap();
            let svg = std::fs::read_to_string(path).unwrap();
            assert_eq!(svg.contains("median"), seeds > 1, "{seeds}");
            assert!(svg.contains("here"));
        }
    }
}
