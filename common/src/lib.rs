//! What crosses a process boundary of Shoal, or is shared by every role.

pub mod algorithms;
pub mod channel;
pub mod commit;
pub mod config;
pub mod durable;
pub mod evaluator_state;
pub mod exit;
pub mod network;
mod packing;
pub mod policy;
pub mod policy_file;
pub mod report;
pub mod run_dir;
pub mod section;
pub mod space;
pub mod stop;
pub mod stream;
pub mod transition;
