//! Pictures of an episode for the page's player, of environments that other programs serve.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use jpeg_encoder::{ColorType, Encoder};
use serde::Serialize;
use serde_json::{Number, Value};
use shoal_env_server::frame::{Frame, Image};
use shoal_run::evaluation::frames::{Frames, keep_every_second};

use super::numbers::short;

/// The greatest height of a picture in pixels.
pub(super) const HEIGHT: u32 = 240;
/// Of a JPEG, from 1 to 100.
const QUALITY: u8 = 80;

/// Pictures of an episode's states 0, `stride`, 2 · `stride`, …, and of its last state if there is one of it.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(super) struct Pictures {
    /// Steps between pictures.
    stride: usize,
    /// URIs of images, all empty if there are drawings.
    images: Vec<String>,
    /// Shapes: `shoal_env_server::environment::Drawing`.
    drawings: Vec<Value>,
}

impl Pictures {
    /// The pictures, thinned out until they take at most `bytes` of the page.
    ///
    /// # Errors
    /// When an image cannot be encoded, or not even two pictures fit.
    pub(super) fn of(frames: &Frames, bytes: usize) -> Result<Self, String> {
        let mut pictures = Self {
            stride: frames.stride,
            ..Self::default()
        };
        for frame in &frames.frames {
            match frame {
                Frame::Image(image) => pictures.images.push(uri(image)?),
                Frame::Drawing(drawing) => {
                    let shapes = serde_json::to_value(drawing).map_err(|error| error.to_string())?;
                    pictures.drawings.push(shortened(shapes));
                }
            }
        }
        if !pictures.images.is_empty() && !pictures.drawings.is_empty() {
            return Err("the environment's server mixes images and drawings".into());
        }
        while pictures.size() > bytes {
            if pictures.count() <= 2 {
                return Err("its pictures are too large for a page".into());
            }
            keep_every_second(&mut pictures.images);
            keep_every_second(&mut pictures.drawings);
            pictures.stride *= 2;
        }
        Ok(pictures)
    }

    fn count(&self) -> usize {
        self.images.len() + self.drawings.len()
    }

    /// Bytes in the page.
    fn size(&self) -> usize {
        let drawn = self.drawings.iter().map(|drawing| drawing.to_string().len());
        drawn.chain(self.images.iter().map(String::len)).sum()
    }
}

fn uri(image: &Image) -> Result<String, String> {
    let side = |pixels: usize| u16::try_from(pixels).map_err(|_| "a picture is too large".to_owned());
    let mut jpeg = Vec::new();
    Encoder::new(&mut jpeg, QUALITY)
        .encode(&image.rgb, side(image.width)?, side(image.height)?, ColorType::Rgb)
        .map_err(|error| format!("a picture cannot be encoded: {error}"))?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg)))
}

/// With numbers as long as a screen shows them.
fn shortened(value: Value) -> Value {
    match value {
        Value::Number(number) => {
            let rounded = number.as_f64().map(short);
            let whole = rounded.filter(|number| number.fract() == 0.0 && number.abs() < 1e6);
            match (whole, rounded.and_then(Number::from_f64)) {
                (Some(whole), _) => Value::from(whole as i64),
                (None, Some(rounded)) => Value::Number(rounded),
                (None, None) => Value::Null,
            }
        }
        Value::Array(items) => items.into_iter().map(shortened).collect(),
        Value::Object(fields) => fields.into_iter().map(|(key, value)| (key, shortened(value))).collect(),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_env_server::environment::{Class, Drawing};

    fn frames(count: usize, frame: impl Fn(usize) -> Frame) -> Frames {
        Frames {
            stride: 3,
            frames: (0..count).map(frame).collect(),
            fps: None,
        }
    }

    fn image(number: usize) -> Frame {
        let (width, height) = (16, 8);
        Frame::Image(Image {
            width,
            height,
            rgb: (0..3 * width * height).map(|i| (i * 7 + number * 50) as u8).collect(),
        })
    }

    #[test]
    fn images_are_jpeg_and_thinned_out_to_the_size_that_they_may_have() {
        let all = Pictures::of(&frames(9, image), 1 << 20).unwrap();
        assert_eq!((all.stride, all.images.len()), (3, 9));
        let bytes = STANDARD.decode(all.images[0].split_once("base64,").unwrap().1).unwrap();
        assert!(bytes.starts_with(&[0xff, 0xd8, 0xff]) && bytes.ends_with(&[0xff, 0xd9]));
        let few = Pictures::of(&frames(9, image), all.size() / 2).unwrap();
        assert_eq!(
            (few.stride, &few.images),
            (12, &[0, 4, 8].map(|i| all.images[i].clone()).into())
        );
        assert!(few.size() <= all.size() / 2);
        assert!(Pictures::of(&frames(9, image), 10).unwrap_err().contains("too large"));
    }

    #[test]
    fn drawings_are_shapes_with_short_numbers() {
        let drawing = |_| {
            let drawing = Drawing::new([0.0, 0.0], [2.0, 1.0]).circle(Class::Body, [1.0 / 3.0, 0.5], 0.1);
            Frame::Drawing(drawing)
        };
        let pictures = Pictures::of(&frames(2, drawing), 1 << 20).unwrap();
        assert_eq!(
            pictures.drawings[1].to_string(),
            r#"{"shapes":[{"circle":[0.33333,0.5,0.1],"class":"body"}],"view":[0,0,2,1]}"#
        );
    }
}
