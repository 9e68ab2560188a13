//! The replay file in use, after crashes, and damaged.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "helpers of tests fail as tests do"
)]

mod chunks;
mod crashes;
mod file;
mod hostile;
mod model;
mod processes;
