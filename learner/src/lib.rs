//! Replay, gradients, Adam, DDPG, checkpoints.

pub mod adam;
pub mod aligned;
pub mod checkpoint;
pub mod ddpg;
pub mod digest;
mod free;
pub mod initialise;
pub mod intake;
pub mod learner;
mod lockstep;
pub mod minibatch;
pub mod pass;
pub mod product;
pub mod ratio;
pub mod replay;
pub mod sampling;
