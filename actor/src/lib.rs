//! The actor, which explores with the policy and its noise and writes transitions, and the evaluator, which acts
//! without noise.

pub mod actor;
mod actor_snapshot;
pub mod environment;
pub mod error;
pub mod evaluator;
pub mod exploration;
pub mod n_step;
pub mod noise;
