//! Exploration: the policy, its noise and the writing of transitions; the same conversation without noise is the
//! evaluator's.

mod actor_snapshot;
pub mod error;
pub mod evaluator;
pub mod exploration;
pub mod explorer;
pub mod noise;
