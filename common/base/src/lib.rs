//! What every process of Shoal speaks of: spaces, rows, reports, random streams, files that are whole or not there.

pub mod durable;
pub mod exit;
pub mod file_lock;
pub mod packing;
pub mod report;
pub mod section;
pub mod space;
pub mod stop;
pub mod stream;
pub mod transition;
