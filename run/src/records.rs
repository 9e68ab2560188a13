//! What a run records at its start, while it runs, and when it ends. Only its launcher writes these files.

pub mod outcome;
pub mod rate;
pub mod recorder;
pub mod start;
