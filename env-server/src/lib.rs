//! The environments, and the server that steps a vector of them. Knows nothing of learning.

pub mod environment;
pub mod server;
pub mod vector;
