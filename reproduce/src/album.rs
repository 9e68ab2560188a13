//! The parts that the report is put together from, and its figures.

use std::path::{Path, PathBuf};

use anyhow::Context;
use shoal_report::figure;

use super::claim::Claim;

/// A part of the report.
pub(super) struct Section {
    pub(super) title: &'static str,
    /// Whose results it is made from: experiments, and their stages' suffixes.
    pub(super) from: Vec<(&'static str, &'static str)>,
    /// What is to be known beforehand, in whole sentences.
    pub(super) remark: String,
    pub(super) claims: Vec<Claim>,
    pub(super) figures: Vec<Figure>,
}

/// A figure that is drawn.
#[derive(Clone, Debug)]
pub(super) struct Figure {
    /// Without an ending.
    pub(super) file: String,
    pub(super) caption: String,
    /// Whether it is there as PNG as well.
    pub(super) png: bool,
}

/// Where figures are drawn.
pub(super) struct Album {
    directory: PathBuf,
    /// Whether each is drawn as PNG as well.
    png: bool,
}

impl Album {
    pub(super) fn in_directory(directory: PathBuf, png: bool) -> anyhow::Result<Self> {
        std::fs::create_dir_all(&directory).with_context(|| format!("cannot make {}", directory.display()))?;
        Ok(Self { directory, png })
    }

    /// Has `draw` draw the figure `name` as SVG. A PNG of what it was before is removed, and made anew if it is wanted.
    pub(super) fn add(
        &self,
        name: &str,
        caption: impl Into<String>,
        draw: impl FnOnce(&Path) -> anyhow::Result<()>,
    ) -> anyhow::Result<Figure> {
        let [svg, png] = ["svg", "png"].map(|ending| self.directory.join(format!("{name}.{ending}")));
        let before = std::fs::read(&svg).ok();
        draw(&svg)?;
        let changed = before.is_none() || before != std::fs::read(&svg).ok();
        if changed && png.exists() {
            std::fs::remove_file(&png).with_context(|| format!("cannot remove {}", png.display()))?;
        }
        if self.png && !png.exists() {
            figure::rasterise(&svg, &png)?;
        }
        Ok(Figure {
            file: name.into(),
            caption: caption.into(),
            png: self.png,
        })
    }
}
