//! Films of a policy's evaluation episodes.

mod failure;
mod ffmpeg;
mod gif;
mod paint;
mod writer;

use std::path::Path;

use anyhow::{Context, bail};
use shoal_common::config::Config;
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::RunDir;
use shoal_common::space::Space;
use shoal_run::description;
use shoal_run::evaluation::rollout::Rollout;
use shoal_run::signals::Interrupt;

use self::failure::FilmFailure;
use self::writer::{FilmWriter, Pictures};

/// About the greatest number of pictures in a film, over all its episodes. Longer episodes are thinned out.
const PICTURES_OF_GIF: usize = 300;
const PICTURES_OF_MP4: usize = 600;
/// The limit for one episode is never below this.
const FEWEST_PICTURES: usize = 20;

/// Steps per second if neither the user nor the environment gives a rate.
const STEPS_PER_SECOND: f64 = 30.0;
/// The same for discrete observations, such as the cells of a grid.
const MOVES_PER_SECOND: f64 = 4.0;

/// The file formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Animated GIF.
    Gif,
    /// MP4, written by the program `ffmpeg`.
    Mp4,
}

impl Format {
    /// The format of a file's name.
    ///
    /// # Errors
    /// When the name has another ending, or the program for this format is missing.
    pub fn of(file: &Path) -> anyhow::Result<Self> {
        let ending = file.extension().map(|ending| ending.to_ascii_lowercase());
        match ending.as_deref().and_then(|ending| ending.to_str()) {
            Some("gif") => Ok(Self::Gif),
            Some("mp4") => ffmpeg::check().map(|()| Self::Mp4),
            _ => bail!("{}: a film's name ends in .gif or .mp4", file.display()),
        }
    }

    /// Whether a file that begins with these bytes has this format.
    pub fn is(self, start: &[u8]) -> bool {
        match self {
            Self::Gif => start.starts_with(b"GIF8"),
            Self::Mp4 => start.get(4..8) == Some(b"ftyp"),
        }
    }
}

/// What is filmed.
#[derive(Clone, Copy, Debug)]
pub struct Request<'a> {
    /// The policy's parameters.
    pub parameters: &'a [f32],
    /// Evaluation episodes 0 … `episodes` − 1 of `seed`.
    pub episodes: u32,
    /// Seed of the start states.
    pub seed: u64,
    /// The pictures' greatest height in pixels; they are at most twice as wide.
    pub height: u32,
    /// Steps shown in a second; `None`: as many as the environment says.
    pub steps_per_second: Option<f64>,
}

/// What a film shows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shown {
    /// Each episode's return and number of steps.
    pub episodes: Vec<(f64, usize)>,
    /// How long the film is, in s.
    pub seconds: f64,
}

/// Plays the episodes and writes their film to `out`, whole or not at all. Calls `progress` with the number of the
/// episode, counted from 0, and the number of its steps.
///
/// # Errors
/// When the environment fails or cannot be drawn, the file cannot be written, or a signal has arrived.
pub fn film(
    run: &RunDir,
    config: &Config,
    request: Request<'_>,
    (out, format): (&Path, Format),
    interrupt: &Interrupt,
    mut progress: impl FnMut(u32, usize),
) -> anyhow::Result<Shown> {
    let rollout = Rollout::of_run(run, config, request.parameters)?;
    let mut rollout = rollout
        .interruptible_by(interrupt.clone())
        .with_pictures(request.height);
    let time_step = description::of_run(run, config)?.time_step;
    let pictures = match format {
        Format::Gif => PICTURES_OF_GIF,
        Format::Mp4 => PICTURES_OF_MP4,
    };
    let most = (pictures / request.episodes.max(1) as usize).max(FEWEST_PICTURES);
    let mut shown = Shown::default();
    write_atomically(out, |file| {
        let mut writer: Option<FilmWriter<'_, _>> = None;
        let mut file = Some(file);
        for number in 0..request.episodes {
            let steps = |steps| progress(number, steps);
            let (trajectory, frames) = rollout.filmed_episode((request.seed, number.into()), most, steps)?;
            let name = &config.environment.name;
            let frames = frames.map_err(|reason| anyhow::anyhow!("{name} cannot be filmed: {reason}"))?;
            let rate = request
                .steps_per_second
                .or(time_step.map(f64::recip))
                .or(frames.fps)
                .unwrap_or(match config.spec.observation {
                    Space::Discrete { .. } => MOVES_PER_SECOND,
                    Space::Box { .. } => STEPS_PER_SECOND,
                });
            let steps = trajectory.actions.len();
            let mut pictures = Pictures::new(&frames, request.height);
            let first = pictures.get(0)?;
            let size = (first.width, first.height);
            let writer = match &mut writer {
                Some(writer) => writer,
                None => {
                    let file = file.take().context("the film was begun twice")?;
                    writer.insert(FilmWriter::new(file, format, size, rate)?)
                }
            };
            shown.seconds += writer.add(&mut pictures, steps, rate, interrupt)?;
            shown.episodes.push((trajectory.episode_return(), steps));
        }
        writer.context("there is no episode")?.finish(interrupt)
    })
    .map_err(|failure| match failure {
        FilmFailure::File(error) => error.context(format!(
            "cannot write {}; choose another place with --out",
            out.display()
        )),
        FilmFailure::Other(error) => error,
    })?;
    Ok(shown)
}

#[cfg(test)]
mod tests;
