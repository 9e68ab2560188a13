//! Bytes that nobody should have written: read or refused, never a panic, and the file stays as it is.

#![allow(
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "a failure anywhere in here is a failed test"
)]

mod bytes;
mod commit;
mod config;
mod policy;
