//! The error for wrong usage of the command line.

/// Wrong usage of the command line: the program ends with the code for that.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);
