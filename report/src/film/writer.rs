//! Writes the pictures of episodes into a film, in either format.

use std::borrow::Cow;
use std::io::Write;

use anyhow::{Context, bail, ensure};
use shoal_env_server::frame::{Frame, Image};
use shoal_run::evaluation::frames::Frames;
use shoal_run::signals::{self, Interrupt};

use super::Format;
use super::failure::FilmFailure;
use super::ffmpeg::Ffmpeg;
use super::gif::GifEncoder;
use super::paint::Painter;

/// Players slow down pictures of a GIF that are shown for less than this many hundredths of a second.
const SHORTEST_DELAY: f64 = 2.0;
/// The greatest number of pictures in a second of an MP4.
const MAX_FPS: f64 = 60.0;
/// How long the last picture of an episode is shown, in s.
pub(super) const PAUSE: f64 = 0.6;

/// The pictures of an episode in pixels, all of one size. They are painted one after another: all of them may be larger
/// than the memory.
pub(super) struct Pictures<'a> {
    frames: &'a Frames,
    painter: Painter,
    size: Option<(usize, usize)>,
    /// The picture that was asked for last, and its number.
    last: Option<(usize, Cow<'a, Image>)>,
    /// The number of drawings that the painter has been given. Each extends the trail.
    drawn: usize,
}

impl<'a> Pictures<'a> {
    pub(super) fn new(frames: &'a Frames, height: u32) -> Self {
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
    pub(super) fn get(&mut self, number: usize) -> anyhow::Result<&Image> {
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
pub(super) struct FilmWriter<'a, W: Write> {
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
    pub(super) fn new(file: &'a mut W, format: Format, size: (usize, usize), rate: f64) -> anyhow::Result<Self> {
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
    pub(super) fn add(
        &mut self,
        pictures: &mut Pictures<'_>,
        steps: usize,
        rate: f64,
        interrupt: &Interrupt,
    ) -> anyhow::Result<f64> {
        // Every episode must have the size of the first.
        pictures.size = Some(self.size);
        match &mut self.encoder {
            Encoder::Gif(gif) => add_to_gif(gif, &mut self.left_over, pictures, steps, rate, interrupt),
            Encoder::Mp4 { ffmpeg, fps, .. } => add_to_mp4(ffmpeg, *fps, pictures, steps, rate, interrupt),
        }
    }

    pub(super) fn finish(self, interrupt: &Interrupt) -> Result<(), FilmFailure> {
        match self.encoder {
            Encoder::Gif(gif) => gif.finish(),
            Encoder::Mp4 { file, ffmpeg, .. } => ffmpeg.finish(file, interrupt),
        }
    }
}

/// Adds the pictures of an episode, and returns how long they are shown, in s. A GIF counts in hundredths of a second;
/// `left_over` carries what rounding leaves from one picture to the next.
fn add_to_gif(
    gif: &mut GifEncoder<impl Write>,
    left_over: &mut f64,
    pictures: &mut Pictures<'_>,
    steps: usize,
    rate: f64,
    interrupt: &Interrupt,
) -> anyhow::Result<f64> {
    let (stride, last) = (pictures.frames.stride, pictures.len() - 1);
    let every = (SHORTEST_DELAY * rate / 100.0 / stride as f64).ceil().max(1.0) as usize;
    let mut seconds = 0.0;
    let shown: Vec<usize> = (0..last).step_by(every).chain([last]).collect();
    for (n, i) in shown.iter().enumerate() {
        check(interrupt)?;
        let step = |i: usize| if i == last { steps } else { i * stride };
        let lasts = shown
            .get(n + 1)
            .map_or(PAUSE, |next| (step(*next) - step(*i)) as f64 / rate);
        let exact = 100.0 * lasts + *left_over;
        let delay = exact.round().clamp(SHORTEST_DELAY, f64::from(u16::MAX));
        *left_over = (exact - delay).clamp(-SHORTEST_DELAY, SHORTEST_DELAY);
        gif.add(pictures.get(*i)?, delay as u16)?;
        seconds += delay / 100.0;
    }
    Ok(seconds)
}

/// Adds the pictures of an episode, `fps` of them in a second, and returns how long they are shown, in s.
fn add_to_mp4(
    ffmpeg: &mut Ffmpeg,
    fps: f64,
    pictures: &mut Pictures<'_>,
    steps: usize,
    rate: f64,
    interrupt: &Interrupt,
) -> anyhow::Result<f64> {
    let (stride, last) = (pictures.frames.stride, pictures.len() - 1);
    let count = ((steps as f64 / rate + PAUSE) * fps).round().max(1.0) as usize;
    for n in 0..count {
        check(interrupt)?;
        let step = (n as f64 / fps * rate + 1e-6) as usize;
        let i = if step >= steps { last } else { (step / stride).min(last) };
        ffmpeg.add(pictures.get(i)?, interrupt)?;
    }
    Ok(count as f64 / fps)
}

fn check(interrupt: &Interrupt) -> anyhow::Result<()> {
    match interrupt.signal() {
        Some(signal) => bail!("ended by {}", signals::describe(signal)),
        None => Ok(()),
    }
}
