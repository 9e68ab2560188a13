//! Converts SVG figures to PNG. The font is built in, so that figures look the same on every machine. This needs the
//! feature `png`.

use std::path::Path;

/// Whether this build can convert figures to PNG.
pub const CAN_RASTERISE: bool = cfg!(feature = "png");

/// Converts the figure in the file `svg` to the file `png`.
///
/// # Errors
/// If a file cannot be read or written, `svg` is not a valid SVG file, or this build has no feature `png`.
pub fn rasterise(svg: &Path, png: &Path) -> anyhow::Result<()> {
    #[cfg(feature = "png")]
    return with_resvg::rasterise(svg, png);
    #[cfg(not(feature = "png"))]
    anyhow::bail!(
        "cannot draw {} from {}: this program was built without the feature `png`",
        png.display(),
        svg.display()
    );
}

#[cfg(feature = "png")]
mod with_resvg {
    use std::io::Write;
    use std::path::Path;
    use std::sync::Arc;

    use anyhow::Context;
    use epaint_default_fonts::UBUNTU_LIGHT;
    use resvg::tiny_skia::{Pixmap, Transform};
    use resvg::usvg::fontdb::Database;
    use resvg::usvg::{Options, Tree};
    use shoal_common::durable::write_atomically;

    /// Pixels of the PNG per pixel of the SVG.
    const SCALE: f32 = 1.5;

    pub(super) fn rasterise(svg: &Path, png: &Path) -> anyhow::Result<()> {
        let text = std::fs::read_to_string(svg).with_context(|| format!("cannot read {}", svg.display()))?;
        let picture = draw(&text).with_context(|| format!("cannot convert {} to PNG", svg.display()))?;
        let bytes = picture.encode_png()?;
        write_atomically(png, |file| file.write_all(&bytes)).with_context(|| format!("cannot write {}", png.display()))
    }

    pub(super) fn draw(svg: &str) -> anyhow::Result<Pixmap> {
        let tree = Tree::from_str(svg, &options())?;
        let size = tree
            .size()
            .to_int_size()
            .scale_by(SCALE)
            .context("the figure is empty")?;
        let mut picture = Pixmap::new(size.width(), size.height()).context("the figure is empty")?;
        resvg::render(&tree, Transform::from_scale(SCALE, SCALE), &mut picture.as_mut());
        Ok(picture)
    }

    /// Uses the built-in font for every font family.
    fn options() -> Options<'static> {
        let mut fonts = Database::new();
        fonts.load_font_data(UBUNTU_LIGHT.to_vec());
        let family = fonts
            .faces()
            .next()
            .and_then(|face| face.families.first())
            .map(|(name, _)| name.clone());
        let family = family.unwrap_or_default();
        fonts.set_sans_serif_family(&family);
        Options {
            fontdb: Arc::new(fonts),
            font_family: family,
            ..Options::default()
        }
    }
}

#[cfg(feature = "png")]
#[cfg(test)]
mod tests {
    use resvg::tiny_skia::Pixmap;

    use super::with_resvg::draw;
    use super::*;

    fn drawn(text: &str) -> Pixmap {
        let svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"60\" height=\"30\"><text x=\"5\" y=\"22\" \
            font-family=\"Helvetica, Arial, sans-serif\" font-size=\"20\">{text}</text></svg>"
        );
        draw(&svg).unwrap()
    }

    #[test]
    fn every_character_of_the_figures_is_drawn() {
        let (nothing, missing) = (drawn(" "), drawn("\u{10FFFD}"));
        for letter in "aZ09(/)±πθ\u{2212}".chars() {
            let letter = (letter, drawn(&letter.to_string()));
            assert!(letter.1 != nothing && letter.1 != missing, "{}", letter.0);
        }
        assert_eq!(
            drawn("\u{10FFFC}"),
            missing,
            "all characters that the font lacks look the same"
        );
    }

    #[test]
    fn the_png_has_the_scaled_size() {
        let dir = tempfile::tempdir().unwrap();
        let [svg, png] = ["a.svg", "a.png"].map(|file| dir.path().join(file));
        std::fs::write(
            &svg,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"60\" height=\"30\"></svg>",
        )
        .unwrap();
        rasterise(&svg, &png).unwrap();
        let bytes = std::fs::read(&png).unwrap();
        assert!(bytes.starts_with(b"\x89PNG"));
        assert_eq!(
            (&bytes[16..20], &bytes[20..24]),
            (&90_u32.to_be_bytes()[..], &45_u32.to_be_bytes()[..])
        );
        std::fs::write(&svg, "not an SVG file").unwrap();
        let error = format!("{:#}", rasterise(&svg, &png).unwrap_err());
        assert!(error.contains("a.svg") && !error.contains('\n'), "{error}");
    }
}
