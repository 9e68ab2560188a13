//! Pictures of an environment's states for a program that watches it, in a file: docs/PROTOCOL.md, "Pictures".

use std::io;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::environment::Drawing;

/// The environment variable that names the file. Without it, a server writes no pictures.
pub const FILE_VARIABLE: &str = "SHOAL_PICTURES";
/// The environment variable with the greatest height of a picture in pixels.
pub const HEIGHT_VARIABLE: &str = "SHOAL_PICTURES_HEIGHT";
/// The format of the file.
const FORMAT: u32 = 1;
/// A picture has at most this many pixels on a side.
const MAX_SIDE: usize = 4_096;
/// Bytes of a header or a drawing, at most.
const MAX_TEXT_BYTES: u64 = 4 << 20;

/// What a state looks like.
#[derive(Clone, Debug, PartialEq)]
pub enum Frame {
    /// Pixels.
    Image(Image),
    /// Shapes.
    Drawing(Drawing),
}

/// Pixels, row by row from the top; three bytes each: red, green, blue.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Image {
    /// Pixels in a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// 3 · width · height bytes.
    pub rgb: Vec<u8>,
}

/// What a server has written into the file.
#[derive(Clone, Debug, PartialEq)]
pub struct Written {
    /// The picture, or the reason why there is none: a sentence without its full stop.
    pub frame: Result<Frame, String>,
    /// How many steps are meant to be shown in a second, if the environment says so.
    pub fps: Option<f64>,
}

#[derive(Serialize, Deserialize)]
struct Header {
    format: u32,
    #[serde(flatten)]
    kind: Kind,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    fps: Option<f64>,
}

#[derive(Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
enum Kind {
    None { reason: String },
    Drawing,
    Rgb { width: usize, height: usize },
}

/// The file of a server that is asked for pictures.
#[derive(Clone, Debug)]
pub struct FrameFile(PathBuf);

impl FrameFile {
    /// The file that this process is asked to write, if it is asked for pictures.
    pub fn wanted() -> Option<Self> {
        let path = std::env::var_os(FILE_VARIABLE).filter(|path| !path.is_empty())?;
        Some(Self(path.into()))
    }

    /// Writes the drawing that `draw` makes, if a picture was asked for since the last one. A failure is logged.
    pub(crate) fn write(&self, draw: impl FnOnce() -> Option<Drawing>, fps: Option<f64>) {
        if self.0.exists() {
            return;
        }
        if let Err(error) = write(&self.0, draw(), fps) {
            tracing::error!("cannot write the picture {}: {error}", self.0.display());
        }
    }
}

fn write(path: &Path, drawing: Option<Drawing>, fps: Option<f64>) -> io::Result<()> {
    let kind = match &drawing {
        Some(_) => Kind::Drawing,
        None => Kind::None {
            reason: "the environment does not draw itself".into(),
        },
    };
    let format = FORMAT;
    let mut text = serde_json::to_string(&Header { format, kind, fps })? + "\n";
    if let Some(drawing) = drawing {
        text += &serde_json::to_string(&drawing)?;
    }
    std::fs::write(path, text)
}

/// Removes the file, so that the server draws the state that the next answer describes.
///
/// # Errors
/// When it cannot be removed.
pub fn ask(path: &Path) -> io::Result<()> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

/// What the server has written since it was [asked](ask); `None` if it has written nothing.
///
/// # Errors
/// When it cannot be read, or does not hold what the protocol says.
pub fn read(path: &Path) -> io::Result<Option<Written>> {
    let size = match std::fs::metadata(path) {
        Ok(file) => file.len(),
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(error),
    };
    if size > (3 * MAX_SIDE * MAX_SIDE) as u64 + MAX_TEXT_BYTES {
        return Err(wrong("it is too large"));
    }
    parse(&std::fs::read(path)?).map(Some)
}

fn parse(bytes: &[u8]) -> io::Result<Written> {
    let end = bytes
        .iter()
        .take(MAX_TEXT_BYTES as usize)
        .position(|byte| *byte == b'\n');
    let (header, rest) = end
        .map(|end| bytes.split_at(end))
        .ok_or_else(|| wrong("it has no header"))?;
    let rest = &rest[1..];
    let header: serde_json::Value = serde_json::from_slice(header)?;
    if header["format"] != FORMAT {
        let found = &header["format"];
        return Err(wrong(&format!(
            "it has format {found}; this program reads format {FORMAT}"
        )));
    }
    let Header { kind, fps, .. } = serde_json::from_value(header)?;
    let frame = match kind {
        Kind::None { reason } => Err(one_line(&reason)),
        Kind::Drawing => Ok(Frame::Drawing(serde_json::from_slice(rest)?)),
        Kind::Rgb { width, height } => {
            let fits = (1..=MAX_SIDE).contains(&width) && (1..=MAX_SIDE).contains(&height);
            if !fits || rest.len() != 3 * width * height {
                let size = format!("{width} × {height} pixels in {} bytes", rest.len());
                return Err(wrong(&format!("it has {size}")));
            }
            let rgb = rest.to_vec();
            Ok(Frame::Image(Image { width, height, rgb }))
        }
    };
    let fps = fps.filter(|fps| fps.is_finite() && *fps > 0.0);
    Ok(Written { frame, fps })
}

/// A reason as it is shown: not too long, without line breaks and control characters, without a full stop.
fn one_line(reason: &str) -> String {
    let words = reason.split_whitespace().collect::<Vec<_>>().join(" ");
    let plain: String = words.chars().filter(|c| !c.is_control()).take(300).collect();
    plain.trim_end_matches('.').into()
}

fn wrong(what: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment::Class;

    fn refusal(bytes: &[u8]) -> String {
        let message = parse(bytes).unwrap_err().to_string();
        assert!(!message.contains('\n'), "{message}");
        message
    }

    #[test]
    fn a_picture_is_written_only_after_it_was_asked_for() {
        let place = std::env::temp_dir().join(format!("shoal-frame-{}", std::process::id()));
        let file = FrameFile(place.clone());
        let drawing = |x| Some(Drawing::new([0.0; 2], [1.0; 2]).circle(Class::Body, [x, 0.0], 1.0));
        file.write(|| drawing(1.0), Some(20.0));
        file.write(|| drawing(2.0), None);
        let written = read(&place).unwrap().unwrap();
        assert_eq!(written.frame, Ok(Frame::Drawing(drawing(1.0).unwrap())));
        assert_eq!(written.fps, Some(20.0));
        ask(&place).unwrap();
        ask(&place).unwrap();
        assert_eq!(read(&place).unwrap(), None);
        file.write(|| None, None);
        let written = read(&place).unwrap().unwrap();
        ask(&place).unwrap();
        assert_eq!(written.frame, Err("the environment does not draw itself".into()));
    }

    #[test]
    fn what_a_server_writes_is_checked() {
        let image = parse(b"{\"format\":1,\"kind\":\"rgb\",\"width\":1,\"height\":2}\nabcdef").unwrap();
        let Ok(Frame::Image(image)) = image.frame else { panic!() };
        assert_eq!((image.width, image.height, &image.rgb[..]), (1, 2, &b"abcdef"[..]));
        let reason = parse(b"{\"format\":1,\"kind\":\"none\",\"reason\":\"no\\npygame.\"}\n").unwrap();
        assert_eq!(reason.frame, Err("no pygame".into()));
        assert!(refusal(b"{\"format\":1,\"kind\":\"rgb\",\"width\":2,\"height\":2}\nabcdef").contains("6 bytes"));
        assert!(refusal(b"{\"format\":2,\"kind\":\"rgb\"}\n").contains("format 2"));
        assert!(refusal(b"{\"format\":1,\"kind\":\"sound\"}\n").contains("sound"));
        assert!(refusal(b"").contains("no header"));
        let huge = format!(
            "{{\"format\":1,\"kind\":\"rgb\",\"width\":{},\"height\":2}}\n",
            usize::MAX
        );
        assert!(refusal(huge.as_bytes()).contains("pixels"));
    }
}
