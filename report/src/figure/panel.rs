//! One diagram: a title, a legend above the data, two axes, and series of points.

use std::ops::Range;

use plotters::prelude::*;
use plotters::style::text_anchor::HPos;

use super::canvas::{Area, FAINT, INK, bold, px, stroke, text, width_of};

const TITLE: f64 = 15.0;
const LABEL: f64 = 13.0;
const TICK: f64 = 12.0;

/// Space around the data, in pixels.
const LEFT: f64 = 64.0;
const RIGHT: f64 = 18.0;
const BOTTOM: f64 = 44.0;
const MARGIN: f64 = 8.0;
const TITLE_ROW: f64 = 30.0;
const LEGEND_ROW: f64 = 22.0;

/// An axis: its label with unit, and its range.
pub(super) struct Axis<'a> {
    pub(super) label: &'a str,
    pub(super) range: Range<f64>,
}

impl<'a> Axis<'a> {
    pub(super) fn new(label: &'a str, range: Range<f64>) -> Self {
        Self { label, range }
    }
}

/// How the points of a series are shown.
#[derive(Clone, Copy)]
pub(super) enum SeriesStyle {
    Line,
    /// The interior of the polygon with these corners.
    Area,
    Dots,
    Rings,
    Crosses,
}

/// A series of points. Those beyond [`MAX_COORDINATE`] or not finite are left out.
pub(super) struct Series<'a> {
    /// Its name in the legend; empty if it has no entry.
    pub(super) label: &'a str,
    pub(super) points: Vec<(f64, f64)>,
    pub(super) style: SeriesStyle,
    pub(super) color: RGBColor,
    pub(super) opacity: f64,
    /// Width of the line, in pixels.
    pub(super) width: f64,
}

impl<'a> Series<'a> {
    pub(super) fn line(label: &'a str, color: RGBColor, points: Vec<(f64, f64)>) -> Self {
        Self {
            label,
            points,
            style: SeriesStyle::Line,
            color,
            opacity: 1.0,
            width: 1.8,
        }
    }
}

/// A diagram.
pub(super) struct Panel<'a> {
    pub(super) title: &'a str,
    /// Text after the legend.
    pub(super) note: &'a str,
    pub(super) x: Axis<'a>,
    pub(super) y: Axis<'a>,
    /// Drawn in this order.
    pub(super) series: Vec<Series<'a>>,
    /// Adapts the range of the x axis, so that both axes have the same scale.
    pub(super) equal_scale: bool,
}

impl<'a> Panel<'a> {
    /// A diagram without a note. Each axis has a scale of its own.
    pub(super) fn new(title: &'a str, x: Axis<'a>, y: Axis<'a>, series: Vec<Series<'a>>) -> Self {
        Self {
            title,
            note: "",
            x,
            y,
            series,
            equal_scale: false,
        }
    }

    pub(super) fn draw(mut self, area: &Area<'_>) -> anyhow::Result<()> {
        let (header, body) = area.split_vertically(px(TITLE_ROW + LEGEND_ROW));
        header.draw_text(
            self.title,
            &bold(TITLE, HPos::Left),
            (px(MARGIN + LEFT), px(TITLE_ROW / 2.0 + 4.0)),
        )?;
        self.draw_legend(&header)?;
        if self.equal_scale {
            self.equalise_scales(&body);
        }

        let mut chart = ChartBuilder::on(&body)
            .margin_left(px(MARGIN))
            .margin_right(px(RIGHT))
            .margin_top(px(MARGIN))
            .margin_bottom(px(MARGIN))
            .x_label_area_size(px(BOTTOM))
            .y_label_area_size(px(LEFT))
            .build_cartesian_2d(self.x.range.clone(), self.y.range.clone())?;
        let (width, height) = chart.plotting_area().dim_in_pixel();
        let y_labels = height / px(42.0) as u32;
        let x_labels = if self.equal_scale {
            y_labels * width / height + 1
        } else {
            width / px(58.0) as u32
        };
        let (x_tick, y_tick) = (Ticks::of(&self.x.range), Ticks::of(&self.y.range));
        chart
            .configure_mesh()
            .light_line_style(TRANSPARENT)
            .bold_line_style(stroke(FAINT, 1.0, 0.8))
            .axis_style(stroke(INK, 1.0, 1.0))
            .set_all_tick_mark_size(px(4.0))
            .x_labels(x_labels as usize)
            .y_labels(y_labels as usize)
            .x_label_formatter(&|x| x_tick.format(*x))
            .y_label_formatter(&|y| y_tick.format(*y))
            .label_style(text(TICK, HPos::Center))
            .axis_desc_style(text(LABEL, HPos::Center))
            .x_desc(self.x.label)
            .y_desc(self.y.label)
            .draw()?;

        for series in &self.series {
            let finite = series
                .points
                .iter()
                .copied()
                .filter(|(x, y)| x.abs() <= MAX_COORDINATE && y.abs() <= MAX_COORDINATE);
            let line = stroke(series.color, series.opacity, series.width);
            match series.style {
                SeriesStyle::Line => chart.draw_series(LineSeries::new(finite, line))?,
                SeriesStyle::Area => {
                    let outline: Vec<_> = finite.collect();
                    let fill = series.color.mix(series.opacity).filled();
                    chart.draw_series((!outline.is_empty()).then(|| Polygon::new(outline, fill)))?
                }
                SeriesStyle::Dots => {
                    let fill = series.color.mix(series.opacity).filled();
                    chart.draw_series(finite.map(|point| Circle::new(point, px(series.width), fill)))?
                }
                SeriesStyle::Rings => chart.draw_series(finite.map(|point| Circle::new(point, px(4.5), line)))?,
                SeriesStyle::Crosses => chart.draw_series(finite.map(|point| Cross::new(point, px(4.5), line)))?,
            };
        }
        Ok(())
    }

    fn draw_legend(&self, header: &Area<'_>) -> anyhow::Result<()> {
        let middle = px(TITLE_ROW + LEGEND_ROW / 2.0);
        let mut x = MARGIN + LEFT;
        for series in self.series.iter().filter(|series| !series.label.is_empty()) {
            let style = stroke(series.color, series.opacity, series.width);
            let (left, centre, right) = ((px(x), middle), (px(x + 10.0), middle), (px(x + 20.0), middle));
            match series.style {
                SeriesStyle::Line => header.draw(&PathElement::new([left, right], style))?,
                SeriesStyle::Area => {
                    let corners = [(px(x), middle - px(5.0)), (px(x + 20.0), middle + px(5.0))];
                    header.draw(&Rectangle::new(corners, series.color.mix(series.opacity).filled()))?;
                }
                SeriesStyle::Dots => header.draw(&Circle::new(centre, px(series.width), series.color.filled()))?,
                SeriesStyle::Rings => header.draw(&Circle::new(centre, px(4.5), style))?,
                SeriesStyle::Crosses => header.draw(&Cross::new(centre, px(4.5), style))?,
            }
            header.draw_text(series.label, &text(LABEL, HPos::Left), (px(x + 26.0), middle))?;
            x += 26.0 + width_of(series.label, LABEL) + 16.0;
        }
        header.draw_text(self.note, &text(LABEL, HPos::Left), (px(x), middle))?;
        Ok(())
    }

    fn equalise_scales(&mut self, body: &Area<'_>) {
        let (width, height) = body.dim_in_pixel();
        let width = f64::from(width) - f64::from(px(MARGIN + LEFT + RIGHT));
        let height = f64::from(height) - f64::from(px(2.0 * MARGIN + BOTTOM));
        let centre = (self.x.range.start + self.x.range.end) / 2.0;
        let half = (self.y.range.end - self.y.range.start) / 2.0 * width / height;
        self.x.range = centre - half..centre + half;
    }
}

/// Formats the numbers along an axis, with as many decimals as the length of its range requires.
struct Ticks {
    decimals: usize,
}

impl Ticks {
    fn of(range: &Range<f64>) -> Self {
        // An axis has about four ticks or more. They need at most two decimals after the first digit of its length.
        let digits = (range.end - range.start).log10().floor();
        Self {
            decimals: (1.0 - digits).clamp(0.0, 6.0) as usize,
        }
    }

    fn format(&self, value: f64) -> String {
        let text = format!("{value:.*}", self.decimals);
        let text = if text.contains('.') {
            text.trim_end_matches('0').trim_end_matches('.')
        } else {
            &text
        };
        match text.strip_prefix('-') {
            Some("0") => "0".into(),
            Some(size) => format!("\u{2212}{size}"),
            None => text.into(),
        }
    }
}

/// Points with larger coordinates are not drawn: the distance between ticks could not be computed.
const MAX_COORDINATE: f64 = 1e30;

/// A range that contains all drawable `values`, with a margin on both sides. It is never so narrow that consecutive
/// ticks would be the same number: plotters would then search for the next tick forever.
pub(super) fn range_of(values: impl Iterator<Item = f64>) -> Range<f64> {
    let drawn = values.filter(|value| value.abs() <= MAX_COORDINATE);
    let (low, high) = drawn.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| {
        (low.min(v), high.max(v))
    });
    if low > high {
        return 0.0..1.0;
    }
    let margin = if high > low {
        let magnitude = low.abs().max(high.abs()).max(1e-3);
        (0.05 * (high - low)).max(1e-6 * magnitude)
    } else {
        (0.05 * high.abs()).max(0.5)
    };
    low - margin..high + margin
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tick_labels_have_no_needless_decimals_and_a_true_minus_sign() {
        let written = |range, values: &[f64]| values.iter().map(|v| Ticks::of(&range).format(*v)).collect::<Vec<_>>();
        assert_eq!(
            written(-1600.0..0.0, &[-1500.0, -500.0, -0.0]),
            ["\u{2212}1500", "\u{2212}500", "0"]
        );
        assert_eq!(written(0.0..3.0, &[0.5, 1.0, 2.5000001]), ["0.5", "1", "2.5"]);
        assert_eq!(written(-0.1..0.1, &[0.05, -0.000_000_1]), ["0.05", "0"]);
    }

    #[test]
    fn a_range_is_never_empty() {
        for values in [
            &[][..],
            &[f64::NAN],
            &[3.0],
            &[0.0, 0.0],
            &[-1600.0, -150.0],
            &[1e9, 1e9],
            &[1.0, 1.0 + f64::EPSILON],
            &[0.0, 5e-324],
            &[-1e30, 1e30],
        ] {
            let range = range_of(values.iter().copied());
            assert!(range.start + 1e-7 * range.end.abs() < range.end, "{values:?}");
            assert!(values.iter().all(|v| v.is_nan() || range.contains(v)), "{values:?}");
        }
    }
}
