//! The learning algorithms: their interface ([`algorithm`]), their list ([`registry`]), and a file for each of them.

pub mod algorithm;
pub mod ddpg;
pub mod dqn;
pub mod minibatch;
pub mod minibatch_algorithm;
mod normaliser;
pub mod registry;
pub mod reinforce;
pub mod sac;
pub mod sampling;
pub mod tabular;
pub mod td3;
#[cfg(test)]
mod testing;
mod twin_critics;
