//! Curves of different settings, in one diagram or in a diagram for each setting with its runs.

use std::path::Path;

use plotters::prelude::RGBColor;

use super::canvas::{BLUE, GREEN, INK, PURPLE, VERMILION, save};
use super::panel::{Axis, Panel, Series};

const COLORS: [RGBColor; 4] = [BLUE, VERMILION, GREEN, PURPLE];

/// The title, axes and reference line shared by the diagrams of a figure.
pub struct DiagramAxes<'a> {
    /// Above the diagram.
    pub title: &'a str,
    /// Label and maximum of the x axis, which starts at 0.
    pub x: (&'a str, f64),
    /// Label, minimum and maximum of the y axis.
    pub y: (&'a str, f64, f64),
    /// Label and y value of a horizontal reference line.
    pub level: Option<(&'a str, f64)>,
}

/// A setting, with the curves of its runs and one curve that summarises them.
pub struct CurvesOfSetting {
    /// Its name in the legend or title.
    pub label: String,
    /// The curve that summarises all runs.
    pub curve: Vec<(f64, f64)>,
    /// The curve of each run.
    pub runs: Vec<Vec<(f64, f64)>>,
}

impl<'a> DiagramAxes<'a> {
    fn panel(&self, title: &'a str, series: Vec<Series<'a>>) -> Panel<'a> {
        let (x, most) = self.x;
        let (y, least, greatest) = self.y;
        let level = self.level.map(|(label, height)| Series {
            opacity: 0.7,
            width: 1.0,
            ..Series::line(label, INK, vec![(0.0, height), (most, height)])
        });
        let series = level.into_iter().chain(series).collect();
        Panel::new(title, Axis::new(x, 0.0..most), Axis::new(y, least..greatest), series)
    }
}

/// Draws the summary curves of all settings in one diagram. There are four colours, which repeat.
pub fn lines(axes: &DiagramAxes<'_>, settings: &[CurvesOfSetting], path: &Path) -> anyhow::Result<()> {
    let series = settings.iter().zip(COLORS.iter().cycle());
    let series = series.map(|(setting, color)| Series::line(&setting.label, *color, setting.curve.clone()));
    let panel = axes.panel(axes.title, series.collect());
    save(path, (860, 470), |sheet| panel.draw(sheet))
}

/// Draws one diagram for each setting, two in a row: thin lines for its runs, a thick one for its summary curve.
pub fn lines_by_setting(axes: &DiagramAxes<'_>, settings: &[CurvesOfSetting], path: &Path) -> anyhow::Result<()> {
    let rows = settings.len().div_ceil(2).max(1);
    save(path, (1160, 380 * rows as u32), |sheet| {
        for (setting, cell) in settings.iter().zip(sheet.split_evenly((rows, 2))) {
            let runs = setting.runs.iter().enumerate().map(|(i, run)| Series {
                opacity: 0.35,
                width: 0.9,
                ..Series::line(if i == 0 { "each seed" } else { "" }, BLUE, run.clone())
            });
            let curve = Series {
                width: 2.4,
                ..Series::line("median", BLUE, setting.curve.clone())
            };
            axes.panel(&setting.label, runs.chain([curve]).collect()).draw(&cell)?;
        }
        Ok(())
    })
}

/// Summarises curves with the same x values, up to the end of the shortest: `summary` gets their sorted values at each
/// x.
pub fn pointwise<X: Copy>(curves: &[Vec<(X, f64)>], summary: impl Fn(&[f64]) -> f64) -> Vec<(X, f64)> {
    let common = curves.iter().map(Vec::len).min().unwrap_or(0);
    let at = |i: usize| {
        let mut values: Vec<f64> = curves.iter().map(|curve| curve[i].1).collect();
        values.sort_by(f64::total_cmp);
        (curves[0][i].0, summary(&values))
    };
    (0..common).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_are_summarised_up_to_the_end_of_the_shortest() {
        let curves = [vec![(1.0, 4.0), (2.0, 5.0)], vec![(1.0, 2.0)]];
        assert_eq!(pointwise(&curves, |sorted| sorted[0]), [(1.0, 2.0)]);
        assert_eq!(pointwise::<f64>(&[], |_| 0.0), []);
    }

    #[test]
    fn settings_and_the_reference_line_are_labelled() {
        let axes = DiagramAxes {
            title: "CartPole",
            x: ("episode", 5_000.0),
            y: ("return", 0.0, 210.0),
            level: Some(("solved", 195.0)),
        };
        let settings: Vec<CurvesOfSetting> = ["plain", "normalised", "skipping"]
            .into_iter()
            .map(|label| CurvesOfSetting {
                label: label.into(),
                curve: vec![(0.0, 20.0), (5_000.0, 200.0)],
                runs: vec![vec![(0.0, 10.0), (5_000.0, 180.0)]],
            })
            .collect();
        let dir = tempfile::tempdir().unwrap();
        for (file, settings) in [("together.svg", &settings[..]), ("none.svg", &[])] {
            lines(&axes, settings, &dir.path().join(file)).unwrap();
            lines_by_setting(&axes, settings, &dir.path().join(format!("apart-{file}"))).unwrap();
        }
        for file in ["together.svg", "apart-together.svg"] {
            let svg = std::fs::read_to_string(dir.path().join(file)).unwrap();
            for label in ["plain", "normalised", "skipping", "solved", "episode"] {
                assert!(svg.lines().any(|line| line.trim() == label), "{file}: {label}");
            }
        }
    }
}
