//! The parts of a gradient step: initial weights, forward and backward passes, products, Adam, and threads.

pub mod adam;
pub mod aligned;
mod columns;
pub mod digest;
pub mod initialise;
pub mod pass;
pub mod product;
pub mod threads;
