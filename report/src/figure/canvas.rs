//! A white sheet that becomes an SVG file, and the shared colours, fonts and stroke widths.

use std::io::Write;
use std::path::Path;

use anyhow::Context;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use shoal_common::durable::write_atomically;

/// A rectangle of the sheet.
pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// The colours of Okabe and Ito, which colour-blind readers can distinguish too.
pub(super) const BLUE: RGBColor = RGBColor(0, 114, 178);
pub(super) const VERMILION: RGBColor = RGBColor(213, 94, 0);
pub(super) const GREEN: RGBColor = RGBColor(0, 158, 115);
pub(super) const PURPLE: RGBColor = RGBColor(204, 121, 167);
pub(super) const INK: RGBColor = RGBColor(38, 38, 38);
pub(super) const FAINT: RGBColor = RGBColor(224, 224, 224);

/// plotters uses integer coordinates. The sheet is therefore drawn this many times larger than it is shown, so that
/// lines are smooth.
const FINE: f64 = 16.0;

/// Converts a length in pixels of the shown figure to plotters' coordinates.
pub(super) fn px(length: f64) -> i32 {
    (length * FINE).round() as i32
}

/// A line `width` pixels wide.
pub(super) fn stroke(color: RGBColor, opacity: f64, width: f64) -> ShapeStyle {
    color.mix(opacity).stroke_width(px(width) as u32)
}

/// Text `size` pixels high, anchored horizontally at `anchor` and vertically at its centre.
pub(super) fn text<'a>(size: f64, anchor: HPos) -> TextStyle<'a> {
    // plotters' SVG backend divides sizes by 1.24.
    let font = ("Helvetica, Arial, sans-serif", size * FINE * 1.24).into_font();
    font.color(&INK).pos(Pos::new(anchor, VPos::Center))
}

/// `text` in bold.
pub(super) fn bold<'a>(size: f64, anchor: HPos) -> TextStyle<'a> {
    let mut style = text(size, anchor);
    style.font = style.font.style(FontStyle::Bold);
    style
}

/// Approximate width of a text in pixels; the exact width depends on the viewer's fonts.
pub(super) fn width_of(text: &str, size: f64) -> f64 {
    text.chars().count() as f64 * size * 0.58
}

/// Draws a figure of `width` × `height` pixels into the file `path`. An existing file is replaced only when the new one
/// is complete.
pub(super) fn save(
    path: &Path,
    (width, height): (u32, u32),
    draw: impl FnOnce(&Area<'_>) -> anyhow::Result<()>,
) -> anyhow::Result<()> {
    let mut svg = String::new();
    let (fine_width, fine_height) = (px(width.into()) as u32, px(height.into()) as u32);
    let sheet = SVGBackend::with_string(&mut svg, (fine_width, fine_height)).into_drawing_area();
    sheet.fill(&WHITE)?;
    draw(&sheet)?;
    sheet.present()?;
    drop(sheet);

    let as_drawn = format!("width=\"{fine_width}\" height=\"{fine_height}\"");
    let as_shown = format!("width=\"{width}\" height=\"{height}\"");
    let svg = svg.replacen(&as_drawn, &as_shown, 1);
    write_atomically(path, |file| file.write_all(svg.as_bytes()))
        .with_context(|| format!("cannot write {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_is_shown_at_its_nominal_size() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("empty.svg");
        save(&path, (300, 200), |_| Ok(())).unwrap();
        let svg = std::fs::read_to_string(path).unwrap();
        assert!(
            svg.starts_with("<svg width=\"300\" height=\"200\" viewBox=\"0 0 4800 3200\""),
            "{svg}"
        );
        assert_eq!(
            std::fs::read_dir(dir.path()).unwrap().count(),
            1,
            "no partial file remains"
        );
    }

    #[test]
    fn the_error_names_a_path_that_cannot_be_written() {
        let error = save(Path::new("/nowhere/at/all.svg"), (300, 200), |_| Ok(())).unwrap_err();
        assert_eq!(error.to_string(), "cannot write /nowhere/at/all.svg");
    }
}
