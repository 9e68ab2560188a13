//! The learning methods: what one is ([`algorithm`]), which there are ([`registry`]), and each of them in a file.

pub mod algorithm;
pub mod ddpg;
pub mod minibatch;
pub mod registry;
pub mod reinforce;
pub mod sampling;
pub mod tabular;
