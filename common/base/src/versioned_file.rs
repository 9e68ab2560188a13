//! Small text files that begin with the number of their format. They are written atomically, and a file that is damaged
//! or has another format is refused.

use std::io::{self, ErrorKind, Write};
use std::path::Path;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::durable::write_atomically;
use crate::message::one_line;

/// How the text of a file is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// One line of JSON.
    Json,
    /// TOML.
    Toml,
}

/// What a file contains, besides its key `format`. The type must not have a key of that name.
pub trait VersionedFile: Serialize + DeserializeOwned {
    /// The number of the format that is written, and the only one that is read. Increase it with every change that an
    /// earlier program would misread.
    const FORMAT: u32;

    /// How the text is written.
    const ENCODING: Encoding = Encoding::Json;

    /// What to do about a damaged file; it follows the words `is damaged`.
    const IF_DAMAGED: &'static str = "";

    /// Reads the file at `path`.
    ///
    /// # Errors
    /// When it is missing, cannot be read, is damaged or has another format.
    fn load(path: &Path) -> Result<Self, VersionedFileError> {
        let shown = path.display().to_string();
        match std::fs::read(path) {
            Ok(text) => Self::parse(&shown, &text),
            Err(cause) => Err(VersionedFileError::Read { path: shown, cause }),
        }
    }

    /// Reads the file at `path`; `None` if there is none.
    ///
    /// # Errors
    /// When it cannot be read, is damaged or has another format.
    fn load_if_any(path: &Path) -> Result<Option<Self>, VersionedFileError> {
        match Self::load(path) {
            Err(VersionedFileError::Read { cause, .. }) if cause.kind() == ErrorKind::NotFound => Ok(None),
            loaded => loaded.map(Some),
        }
    }

    /// Reads the text of a file that messages call `path`. The format is checked first: a file of another format
    /// may lack the other keys.
    ///
    /// # Errors
    /// When it is damaged or has another format.
    fn parse(path: &str, text: &[u8]) -> Result<Self, VersionedFileError> {
        let Head { format } = decode::<Self, _>(path, text)?;
        if format != Self::FORMAT {
            return Err(VersionedFileError::Format {
                path: path.into(),
                found: format,
                expected: Self::FORMAT,
            });
        }
        decode::<Self, _>(path, text)
    }

    /// Writes the file atomically, for its owner alone.
    ///
    /// # Errors
    /// When it cannot be written.
    fn store(&self, path: &Path) -> Result<(), VersionedFileError> {
        let whole = Whole {
            format: Self::FORMAT,
            contents: self,
        };
        let text = match Self::ENCODING {
            Encoding::Json => serde_json::to_string(&whole)
                .map(|text| text + "\n")
                .map_err(io::Error::from),
            Encoding::Toml => toml::to_string(&whole).map_err(io::Error::other),
        };
        text.and_then(|text| write_atomically(path, |file| file.write_all(text.as_bytes())))
            .map_err(|cause| VersionedFileError::Write {
                path: path.display().to_string(),
                cause,
            })
    }
}

/// Why a file cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum VersionedFileError {
    /// The system did not let it be read; it may be missing.
    #[error("cannot read {path}: {cause}")]
    Read {
        /// The file.
        path: String,
        /// The system's reason.
        cause: io::Error,
    },
    /// It was not written.
    #[error("cannot write {path}: {cause}")]
    Write {
        /// The file.
        path: String,
        /// The system's reason.
        cause: io::Error,
    },
    /// It is not such a file, or was cut short.
    #[error("{path} is damaged{advice}: {cause}")]
    Damaged {
        /// The file.
        path: String,
        /// What to do.
        advice: &'static str,
        /// What is wrong with its text.
        cause: String,
    },
    /// Another version of the program wrote it.
    #[error("{path} has format {found}; this program reads format {expected}")]
    Format {
        /// The file.
        path: String,
        /// The file's format.
        found: u32,
        /// This program's.
        expected: u32,
    },
}

/// What a file has in every format.
#[derive(Deserialize)]
struct Head {
    format: u32,
}

#[derive(Serialize)]
struct Whole<'a, T> {
    format: u32,
    #[serde(flatten)]
    contents: &'a T,
}

fn decode<F: VersionedFile, T: DeserializeOwned>(path: &str, text: &[u8]) -> Result<T, VersionedFileError> {
    let decoded = match F::ENCODING {
        Encoding::Json => serde_json::from_slice(text).map_err(|error| error.to_string()),
        Encoding::Toml => std::str::from_utf8(text)
            .map_err(|error| error.to_string())
            .and_then(|text| toml::from_str(text).map_err(|error| one_line(error.message()))),
    };
    decoded.map_err(|cause| VersionedFileError::Damaged {
        path: path.into(),
        advice: F::IF_DAMAGED,
        cause,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Json {
        large: u64,
        number: Option<f64>,
    }

    impl VersionedFile for Json {
        const FORMAT: u32 = 3;
        const IF_DAMAGED: &'static str = "; remove it";
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Toml {
        names: Vec<String>,
    }

    impl VersionedFile for Toml {
        const FORMAT: u32 = 1;
        const ENCODING: Encoding = Encoding::Toml;
    }

    #[test]
    fn a_file_is_read_as_it_was_written_and_others_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        assert_eq!(Json::load_if_any(&path).unwrap(), None);
        assert!(Json::load(&path).unwrap_err().to_string().starts_with("cannot read "));
        let json = Json {
            large: u64::MAX,
            number: Some(0.1),
        };
        json.store(&path).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text, "{\"format\":3,\"large\":18446744073709551615,\"number\":0.1}\n");
        assert_eq!(Json::load(&path).unwrap(), json);
        let toml = Toml {
            names: vec!["a".into()],
        };
        toml.store(&path).unwrap();
        let text = std::fs::read_to_string(&path).unwrap();
        assert_eq!(text, "format = 1\nnames = [\"a\"]\n");
        assert_eq!(Toml::load_if_any(&path).unwrap(), Some(toml));

        let refused = |text: &str| Json::parse("x.json", text.as_bytes()).unwrap_err().to_string();
        assert_eq!(
            refused("{\"format\":4}"),
            "x.json has format 4; this program reads format 3"
        );
        for damaged in ["", "{", "{\"large\":1}", "{\"format\":3,\"large\":-1}", "\u{fffd}"] {
            let message = refused(damaged);
            assert!(message.starts_with("x.json is damaged; remove it: "), "{message}");
            assert!(!message.contains('\n'), "{message}");
        }
        let message = Toml::parse("x.toml", b"format = 1\nnames = [1]")
            .unwrap_err()
            .to_string();
        assert!(
            message.starts_with("x.toml is damaged: ") && !message.contains('\n'),
            "{message}"
        );
        let missing = directory.path().join("nowhere").join("file");
        assert!(
            json.store(&missing)
                .unwrap_err()
                .to_string()
                .starts_with("cannot write ")
        );
    }
}
