//! The actor, which explores with the policy and its noise and writes transitions, and the evaluator, which acts
//! without noise.

mod actor_snapshot;
pub mod error;
pub mod evaluator;
pub mod exploration;
pub mod explorer;
pub mod n_step;
pub mod noise;
