//! Films of a policy's evaluation episodes.

mod ffmpeg;
mod gif;
mod paint;

use std::borrow::Cow;
use std::io::{self, Write};
use std::path::Path;

use anyhow::{Context, bail, ensure};
use shoal_common::config::Config;
use shoal_common::durable::write_atomically;
use shoal_common::run_dir::RunDir;
use shoal_common::space::Space;
use shoal_env_server::frame::{Frame, Image};
use shoal_run::description;
use shoal_run::evaluation::frames::Frames;
use shoal_run::evaluation::rollout::Rollout;
use shoal_run::signals::{self, Interrupt};

use self::ffmpeg::Ffmpeg;
use self::gif::GifEncoder;
pub(crate) use self::paint::Painter;

/// About the greatest number of pictures in a film, over all its episodes. Longer episodes are thinned out.
const PICTURES_OF_GIF: usize = 300;
const PICTURES_OF_MP4: usize = 600;
/// The limit for one episode is never below this.
const FEWEST_PICTURES: usize = 20;

/// Players slow down pictures of a GIF that are shown for less than this many hundredths of a second.
const SHORTEST_DELAY: f64 = 2.0;
/// The greatest number of pictures in a second of an MP4.
const MAX_FPS: f64 = 60.0;
/// How long the last picture of an episode is shown, in s.
const PAUSE: f64 = 0.6;

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

/// Why there is no film: its file cannot be written, or something else.
#[derive(Debug)]
enum FilmFailure {
    File(anyhow::Error),
    Other(anyhow::Error),
}

impl From<io::Error> for FilmFailure {
    fn from(error: io::Error) -> Self {
        Self::File(error.into())
    }
}

impl From<::gif::EncodingError> for FilmFailure {
    fn from(error: ::gif::EncodingError) -> Self {
        Self::File(error.into())
    }
}

impl From<anyhow::Error> for FilmFailure {
    fn from(error: anyhow::Error) -> Self {
        if error.is::<::gif::EncodingError>() {
            Self::File(error)
        } else {
            Self::Other(error)
        }
    }
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

/// The pictures of an episode in pixels, all of one size. They are painted one after another: all of them may be larger
/// than the memory.
struct Pictures<'a> {
    frames: &'a Frames,
    painter: Painter,
    size: Option<(usize, usize)>,
    /// The picture that was asked for last, and its number.
    last: Option<(usize, Cow<'a, Image>)>,
    /// The number of drawings that the painter has been given. Each extends the trail.
    drawn: usize,
}

impl<'a> Pictures<'a> {
    fn new(frames: &'a Frames, height: u32) -> Self {
        Self {
            frames,
            painter: Painter::new(height),
            size: None,
            last: None,
            drawn: 0,
        }
    }

    fn len(&self) -> usize {
        self.frames.frames.len()
    }

    /// The picture with this number, which is not before the one that was asked for last.
    ///
    /// # Errors
    /// When it has no size, or another one than those before.
    fn get(&mut self, number: usize) -> anyhow::Result<&Image> {
        let image = match self.last.take() {
            Some((last, image)) if last == number => image,
            _ => {
                for frame in self.frames.frames.iter().take(number).skip(self.drawn) {
                    if let Frame::Drawing(drawing) = frame {
                        self.painter.leave_out(drawing);
                    }
                }
                self.drawn = number + 1;
                let image = match self.frames.frames.get(number) {
                    Some(Frame::Image(image)) => Some(Cow::Borrowed(image)),
                    Some(Frame::Drawing(drawing)) => self.painter.paint(drawing).map(Cow::Owned),
                    None => None,
                };
                image.context("the environment's drawing has no size")?
            }
        };
        let size = (image.width, image.height);
        let first = *self.size.get_or_insert(size);
        ensure!(size == first, "the environment's pictures change their size");
        let (_, image) = self.last.insert((number, image));
        Ok(image)
    }
}

/// Writes pictures in either format.
struct FilmWriter<'a, W: Write> {
    size: (usize, usize),
    /// Hundredths of a second that rounding has left over.
    left_over: f64,
    encoder: Encoder<'a, W>,
}

enum Encoder<'a, W: Write> {
    Gif(GifEncoder<&'a mut W>),
    Mp4 { file: &'a mut W, ffmpeg: Ffmpeg, fps: f64 },
}

impl<'a, W: Write> FilmWriter<'a, W> {
    fn new(file: &'a mut W, format: Format, size: (usize, usize), rate: f64) -> anyhow::Result<Self> {
        let encoder = match format {
            Format::Gif => Encoder::Gif(GifEncoder::new(file, size)?),
            Format::Mp4 => {
                // A whole number of steps per picture.
                let fps = rate / (rate / MAX_FPS).ceil().max(1.0);
                let ffmpeg = Ffmpeg::start(size, fps)?;
                Encoder::Mp4 { file, ffmpeg, fps }
            }
        };
        let left_over = 0.0;
        Ok(Self {
            size,
            left_over,
            encoder,
        })
    }

    /// Adds the pictures of an episode, and returns how long they are shown, in s.
    fn add(
        &mut self,
        pictures: &mut Pictures<'_>,
        steps: usize,
        rate: f64,
        interrupt: &Interrupt,
    ) -> anyhow::Result<f64> {
        // Every episode must have the size of the first.
        pictures.size = Some(self.size);
        let (stride, last) = (pictures.frames.stride, pictures.len() - 1);
        match &mut self.encoder {
            Encoder::Gif(gif) => {
                let every = (SHORTEST_DELAY * rate / 100.0 / stride as f64).ceil().max(1.0) as usize;
                let mut seconds = 0.0;
                let shown: Vec<usize> = (0..last).step_by(every).chain([last]).collect();
                for (n, i) in shown.iter().enumerate() {
                    check(interrupt)?;
                    let step = |i: usize| if i == last { steps } else { i * stride };
                    let lasts = shown
                        .get(n + 1)
                        .map_or(PAUSE, |next| (step(*next) - step(*i)) as f64 / rate);
                    let exact = 100.0 * lasts + self.left_over;
                    let delay = exact.round().clamp(SHORTEST_DELAY, f64::from(u16::MAX));
                    self.left_over = (exact - delay).clamp(-SHORTEST_DELAY, SHORTEST_DELAY);
                    gif.add(pictures.get(*i)?, delay as u16)?;
                    seconds += delay / 100.0;
                }
                Ok(seconds)
            }
            Encoder::Mp4 { ffmpeg, fps, .. } => {
                let count = ((steps as f64 / rate + PAUSE) * *fps).round().max(1.0) as usize;
                for n in 0..count {
                    check(interrupt)?;
                    let step = (n as f64 / *fps * rate + 1e-6) as usize;
                    let i = if step >= steps { last } else { (step / stride).min(last) };
                    ffmpeg.add(pictures.get(i)?, interrupt)?;
                }
                Ok(count as f64 / *fps)
            }
        }
    }

    fn finish(self, interrupt: &Interrupt) -> Result<(), FilmFailure> {
        match self.encoder {
            Encoder::Gif(gif) => gif.finish(),
            Encoder::Mp4 { file, ffmpeg, .. } => ffmpeg.finish(file, interrupt),
        }
    }
}

fn check(interrupt: &Interrupt) -> anyhow::Result<()> {
    match interrupt.signal() {
        Some(signal) => bail!("ended by {}", signals::describe(signal)),
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests;
