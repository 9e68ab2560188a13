//! The environments, and the server that steps a vector of them. It does not depend on how anything is learned.

pub mod description;
pub mod environment;
pub mod frame;
pub mod program;
pub mod server;
pub mod vector;

pub use program::serve;
pub use shoal_base::{space, stream};
