//! Checkpoints, with writers that are killed and bytes that nobody should have written.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "helpers of tests fail as tests do"
)]

mod hostile;
mod kills;
