//! What every process of Shoal uses: spaces, transitions, roles and their reports, declared settings, random streams,
//! and files that are either complete or absent.

pub mod durable;
pub mod exit;
pub mod file_lock;
pub mod message;
pub mod numbers;
pub mod packing;
pub mod report;
pub mod role;
pub mod section;
pub mod space;
pub mod stop;
pub mod stream;
pub mod transition;
pub mod versioned_file;
