//! The learning methods: their interface ([`algorithm`]), their list ([`registry`]), and a file for each of them.

pub mod algorithm;
pub mod ddpg;
pub mod minibatch;
pub mod registry;
pub mod reinforce;
pub mod sampling;
pub mod tabular;
