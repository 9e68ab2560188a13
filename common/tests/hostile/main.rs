//! Damaged and forged files: they are read or refused without a panic, and are never changed.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a panic is a failed test")]

mod bytes;
mod commit;
mod config;
mod policy;
