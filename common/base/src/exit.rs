//! How a role's loop ends before its work is done.

use std::error::Error;
use std::fmt;

/// Why a role's loop ends early: it was asked to stop, or it failed with an `E`.
///
/// It does not implement [`Error`], so that `?` can convert every error that converts into `E`. To convert between
/// exits with different errors, use [`map_err`](Result::map_err) with [`Exit::convert`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Exit<E> {
    /// The role was asked to end, which is not a failure.
    Stopped,
    /// The role cannot continue.
    Failed(E),
}

impl<E> Exit<E> {
    /// Converts the error into a wider error type.
    pub fn convert<F: From<E>>(self) -> Exit<F> {
        match self {
            Self::Stopped => Exit::Stopped,
            Self::Failed(error) => Exit::Failed(error.into()),
        }
    }

    /// The loop's result; a requested end counts as success.
    ///
    /// # Errors
    /// When the loop failed.
    pub fn into_result(self) -> Result<(), E> {
        match self {
            Self::Stopped => Ok(()),
            Self::Failed(error) => Err(error),
        }
    }
}

impl<E, F: Error + Into<E>> From<F> for Exit<E> {
    fn from(error: F) -> Self {
        Self::Failed(error.into())
    }
}

impl<E: fmt::Display> fmt::Display for Exit<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Stopped => f.write_str("asked to end"),
            Self::Failed(error) => error.fmt(f),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::num::{ParseFloatError, ParseIntError};

    use super::*;

    #[derive(Debug, PartialEq)]
    enum RoleError {
        Whole(ParseIntError),
        Float(ParseFloatError),
    }

    impl From<ParseIntError> for RoleError {
        fn from(error: ParseIntError) -> Self {
            Self::Whole(error)
        }
    }

    impl From<ParseFloatError> for RoleError {
        fn from(error: ParseFloatError) -> Self {
            Self::Float(error)
        }
    }

    /// A wait that is stopped when the text is empty.
    fn wait(text: &str) -> Result<u8, Exit<ParseIntError>> {
        if text.is_empty() {
            return Err(Exit::Stopped);
        }
        Ok(text.parse()?)
    }

    fn role(whole: &str, float: &str) -> Result<f64, Exit<RoleError>> {
        let whole = wait(whole).map_err(Exit::convert)?;
        let float: f64 = float.parse()?;
        Ok(f64::from(whole) + float)
    }

    #[test]
    fn an_exit_keeps_its_reason_when_it_is_converted() {
        assert_eq!(role("1", "0.5"), Ok(1.5));
        assert_eq!(role("", "0.5"), Err(Exit::Stopped));
        let (whole, float) = ("x".parse::<u8>().unwrap_err(), "y".parse::<f64>().unwrap_err());
        assert_eq!(role("x", "0.5"), Err(Exit::Failed(RoleError::Whole(whole.clone()))));
        assert_eq!(role("1", "y"), Err(Exit::Failed(RoleError::Float(float))));
        assert_eq!(Exit::<ParseIntError>::Stopped.into_result(), Ok(()));
        assert_eq!(Exit::Failed(whole.clone()).into_result(), Err(whole));
    }
}
