//! A white sheet that becomes an SVG file, and what everything drawn on it has in common: colours, type, stroke widths.

use std::io::Write;
use std::path::Path;

use anyhow::Context;
use plotters::coord::Shift;
use plotters::prelude::*;
use plotters::style::text_anchor::{HPos, Pos, VPos};
use shoal_common::durable::write_atomically;

/// A rectangle of the sheet.
pub(super) type Area<'a> = DrawingArea<SVGBackend<'a>, Shift>;

/// Okabe and Ito's colours, which people of every kind of colour vision tell apart.
pub(super) const BLUE: RGBColor = RGBColor(0, 114, 178);
pub(super) const VERMILION: RGBColor = RGBColor(213, 94, 0);
pub(super) const GREEN: RGBColor = RGBColor(0, 158, 115);
pub(super) const PURPLE: RGBColor = RGBColor(204, 121, 167);
pub(super) const INK: RGBColor = RGBColor(38, 38, 38);
pub(super) const FAINT: RGBColor = RGBColor(224, 224, 224);

/// plotters' coordinates are whole numbers. The sheet is drawn this many times too large and shown at its proper size,
/// so that lines have no steps.
const FINE: f64 = 16.0;

/// A length in pixels of the shown picture, in plotters' coordinates.
pub(super) fn px(length: f64) -> i32 {
    (length * FINE).round() as i32
}

/// A line `width` pixels wide.
pub(super) fn stroke(color: RGBColor, opacity: f64, width: f64) -> ShapeStyle {
    color.mix(opacity).stroke_width(px(width) as u32)
}

/// Text `size` pixels high, anchored at its left or right end or its centre, and half-way up.
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

/// About how many pixels wide a text of this size is; only the reader's machine knows exactly.
pub(super) fn width_of(text: &str, size: f64) -> f64 {
    text.chars().count() as f64 * size * 0.58
}

/// Draws a picture of `width` × `height` pixels into the file `path`. What was there before stays until it is complete.
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
    fn the_picture_is_shown_at_its_proper_size() {
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
            "no partial file stays"
        );
    }

    #[test]
    fn a_place_that_cannot_be_written_is_named() {
        let error = save(Path::new("/nowhere/at/all.svg"), (300, 200), |_| Ok(())).unwrap_err();
        assert_eq!(error.to_string(), "cannot write /nowhere/at/all.svg");
    }
}
