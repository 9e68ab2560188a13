//! Checkpoints with killed writers and hostile content.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "helpers of tests fail as tests do"
)]

mod hostile;
mod kills;
