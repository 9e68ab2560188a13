//! The sections of the report and its figures.

use std::path::{Path, PathBuf};

use anyhow::Context;
use shoal_report::figure;

use super::claim::Claim;

/// A part of the report.
pub(super) struct ReportSection {
    pub(super) title: &'static str,
    /// The results that it uses: experiments with the suffixes of their milestones.
    pub(super) from: Vec<(&'static str, &'static str)>,
    /// Markdown before the table of claims; may be empty.
    pub(super) remark: String,
    pub(super) claims: Vec<Claim>,
    pub(super) figures: Vec<Figure>,
}

/// A figure that has been drawn.
#[derive(Clone, Debug)]
pub(super) struct Figure {
    /// Its file name without extension.
    pub(super) file: String,
    pub(super) caption: String,
    /// Whether there is a PNG file too.
    pub(super) png: bool,
}

/// Draws figures into a directory.
pub(super) struct FigureWriter {
    directory: PathBuf,
    /// Whether to convert each figure to PNG too.
    png: bool,
}

impl FigureWriter {
    pub(super) fn in_directory(directory: PathBuf, png: bool) -> anyhow::Result<Self> {
        std::fs::create_dir_all(&directory).with_context(|| format!("cannot create {}", directory.display()))?;
        Ok(Self { directory, png })
    }

    /// Draws the figure `name` as SVG with `draw`. If that changes it, an existing PNG is removed, and made again if
    /// PNG is on.
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
