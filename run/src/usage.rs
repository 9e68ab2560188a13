//! The error for a command line that asks for what cannot be.

/// Wrong usage of the command line: the program ends with the code for that.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct UsageError(pub String);
