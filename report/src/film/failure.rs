//! Why there is no film.

use std::io;

/// A film's file cannot be written, or something else has failed.
#[derive(Debug)]
pub(super) enum FilmFailure {
    File(anyhow::Error),
    Other(anyhow::Error),
}

impl From<io::Error> for FilmFailure {
    fn from(error: io::Error) -> Self {
        Self::File(error.into())
    }
}

impl From<gif::EncodingError> for FilmFailure {
    fn from(error: gif::EncodingError) -> Self {
        Self::File(error.into())
    }
}

impl From<anyhow::Error> for FilmFailure {
    fn from(error: anyhow::Error) -> Self {
        if error.is::<gif::EncodingError>() {
            Self::File(error)
        } else {
            Self::Other(error)
        }
    }
}
