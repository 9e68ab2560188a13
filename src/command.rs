//! What `shoal` does once the command line is read, a command a file.

pub(crate) mod bench;
pub(crate) mod eval;
pub(crate) mod plot;
pub(crate) mod train;
