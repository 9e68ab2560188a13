//! Films as GIF.

use std::io::Write;

use anyhow::Context;
use gif::{DisposalMethod, Encoder, Frame, Repeat};
use shoal_env_server::frame::Image;

use super::failure::FilmFailure;

/// How carefully the colours of a picture with more than 256 are chosen: 1 is best, 30 is fastest.
const SPEED: i32 = 10;

/// Writes pictures one after the other. Each is stored as its difference from the picture before.
pub(super) struct GifEncoder<W: Write> {
    encoder: Encoder<W>,
    width: usize,
    height: usize,
    shown: Option<Image>,
    /// The last picture, which is written once it is known for how long it is shown.
    pending: Option<Frame<'static>>,
}

impl<W: Write> GifEncoder<W> {
    /// A film of pictures of this size that begins again when it has ended.
    pub(super) fn new(writer: W, (width, height): (usize, usize)) -> anyhow::Result<Self> {
        let side = |pixels: usize| u16::try_from(pixels).context("the pictures are too large for a GIF");
        let mut encoder = Encoder::new(writer, side(width)?, side(height)?, &[])?;
        encoder.set_repeat(Repeat::Infinite)?;
        Ok(Self {
            encoder,
            width,
            height,
            shown: None,
            pending: None,
        })
    }

    /// Adds a picture that is shown for `delay` hundredths of a second.
    pub(super) fn add(&mut self, image: &Image, delay: u16) -> anyhow::Result<()> {
        let Some(mut next) = self.change_to(image) else {
            if let Some(pending) = &mut self.pending {
                pending.delay = pending.delay.saturating_add(delay);
            }
            return Ok(());
        };
        next.delay = delay;
        self.shown = Some(image.clone());
        if let Some(before) = self.pending.replace(next) {
            self.encoder.write_frame(&before)?;
        }
        Ok(())
    }

    /// Writes what is left.
    pub(super) fn finish(mut self) -> Result<(), FilmFailure> {
        if let Some(last) = self.pending.take() {
            self.encoder.write_frame(&last)?;
        }
        self.encoder.into_inner()?.flush()?;
        Ok(())
    }

    /// The smallest rectangle that turns the shown picture into this one; transparent where nothing changes. `None` if
    /// nothing changes at all.
    fn change_to(&self, image: &Image) -> Option<Frame<'static>> {
        let (width, height) = (self.width, self.height);
        let differs = |i: usize| {
            let range = 3 * i..3 * i + 3;
            self.shown
                .as_ref()
                .is_none_or(|shown| shown.rgb[range.clone()] != image.rgb[range])
        };
        let changed = || (0..width * height).filter(|i| differs(*i));
        let (top, bottom) = (changed().next()? / width, changed().next_back()? / width);
        let (left, right) = changed().fold((width, 0), |(left, right), i| {
            (left.min(i % width), right.max(i % width))
        });
        let mut rgba = Vec::with_capacity(4 * (right - left + 1) * (bottom - top + 1));
        for y in top..=bottom {
            for i in y * width + left..=y * width + right {
                rgba.extend_from_slice(&image.rgb[3 * i..3 * i + 3]);
                rgba.push(if differs(i) { 255 } else { 0 });
            }
        }
        // All are sides within the size, which fits.
        let [w, h, left, top] = [right - left + 1, bottom - top + 1, left, top].map(|side| side as u16);
        let mut frame = Frame::from_rgba_speed(w, h, &mut rgba, SPEED);
        (frame.left, frame.top, frame.dispose) = (left, top, DisposalMethod::Keep);
        Some(frame)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// The pictures of a GIF as they are seen, each with its delay.
    pub(in crate::film) fn decoded(bytes: &[u8]) -> Vec<(Image, u16)> {
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(bytes).unwrap();
        let (width, height) = (usize::from(decoder.width()), usize::from(decoder.height()));
        let mut canvas = vec![0; 3 * width * height];
        let mut seen = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            let [left, top, w] = [frame.left, frame.top, frame.width].map(usize::from);
            for (i, pixel) in frame
                .buffer
                .chunks_exact(4)
                .enumerate()
                .filter(|(_, pixel)| pixel[3] > 0)
            {
                let at = (top + i / w) * width + left + i % w;
                canvas[3 * at..3 * at + 3].copy_from_slice(&pixel[..3]);
            }
            let rgb = canvas.clone();
            seen.push((Image { width, height, rgb }, frame.delay));
        }
        seen
    }

    fn picture(colour: impl Fn(usize, usize) -> [u8; 3]) -> Image {
        let (width, height) = (40, 30);
        Image {
            width,
            height,
            rgb: (0..width * height).flat_map(|i| colour(i % width, i / width)).collect(),
        }
    }

    #[test]
    fn pictures_are_seen_as_they_were_and_equal_ones_last_longer() {
        let square = |at: usize| {
            picture(move |x, y| {
                if x / 5 == at && y / 5 == 2 {
                    [9, 99, 199]
                } else {
                    [255; 3]
                }
            })
        };
        let mut bytes = Vec::new();
        let mut film = GifEncoder::new(&mut bytes, (40, 30)).unwrap();
        for (at, delay) in [(1, 3), (1, 4), (2, 5), (6, 7)] {
            film.add(&square(at), delay).unwrap();
        }
        film.finish().unwrap();
        assert_eq!(decoded(&bytes), [(square(1), 7), (square(2), 5), (square(6), 7)]);
    }

    /// A file that cannot be written to its end.
    struct Full;

    impl Write for Full {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            Ok(bytes.len())
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Err(std::io::ErrorKind::StorageFull.into())
        }
    }

    #[test]
    fn a_file_that_cannot_be_written_to_its_end_is_told_from_other_failures() {
        let mut film = GifEncoder::new(Full, (40, 30)).unwrap();
        film.add(&picture(|_, _| [255; 3]), 2).unwrap();
        assert!(matches!(film.finish(), Err(FilmFailure::File(_))));
    }

    #[test]
    fn many_colours_are_nearly_kept() {
        let colourful = picture(|x, y| [(6 * x) as u8, (8 * y) as u8, (3 * x + 4 * y) as u8]);
        let mut bytes = Vec::new();
        let mut film = GifEncoder::new(&mut bytes, (40, 30)).unwrap();
        film.add(&picture(|_, _| [255; 3]), 2).unwrap();
        film.add(&colourful, 2).unwrap();
        film.finish().unwrap();
        let seen = &decoded(&bytes)[1].0.rgb;
        let off: u64 = seen
            .iter()
            .zip(&colourful.rgb)
            .map(|(a, b)| u64::from(a.abs_diff(*b)))
            .sum();
        let mean = off as f64 / seen.len() as f64;
        assert!(mean < 12.0, "colours are off by {mean} in the mean");
    }
}
