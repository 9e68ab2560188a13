//! The parts of a gradient step: initial weights, forward and backward passes, products, Adam, threads, and a network
//! with all that belongs to it.

pub mod adam;
pub mod aligned;
mod columns;
pub mod digest;
pub mod initialise;
pub mod pass;
pub mod product;
pub mod threads;
pub mod trainable;
