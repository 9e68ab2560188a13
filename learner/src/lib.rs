//! Replay, gradients, Adam, the algorithms (DDPG, REINFORCE, Q-learning, SARSA), checkpoints.

pub mod adam;
pub mod algorithm;
pub mod aligned;
pub mod checkpoint;
pub mod ddpg;
pub mod digest;
mod free;
pub mod initialise;
pub mod intake;
mod judging;
pub mod learner;
mod lockstep;
pub mod minibatch;
pub mod pass;
pub mod product;
pub mod ratio;
pub mod reinforce;
pub mod replay;
pub mod replayed_ddpg;
pub mod sampling;
pub mod tabular;
pub mod threads;
