//! What a network's update is computed with: first weights, passes forward and backward, products, Adam, and threads.

pub mod adam;
pub mod aligned;
mod columns;
pub mod digest;
pub mod initialise;
pub mod pass;
pub mod product;
pub mod threads;
