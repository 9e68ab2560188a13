//! The actor, which explores and writes transitions, and the evaluator, which acts without exploration.

pub mod actor;
mod actor_snapshot;
pub mod environment;
mod episode_reports;
pub mod error;
pub mod evaluator;
pub mod exploration;
pub mod n_step;
pub mod noise;
