//! Everything about a run except starting it: its configuration and directory, the resources it needs, its records, and
//! the evaluation of its policies.

pub mod algorithm;
pub mod analysis;
pub mod batch;
pub mod best_policy;
pub mod client;
pub mod description;
pub mod earlier_best;
pub mod evaluation;
pub mod external_environment;
pub mod final_evaluation;
pub mod joining;
pub mod numbers;
pub mod origin;
pub mod outcome;
pub mod plan;
pub mod preflight;
pub mod process;
pub mod rate;
pub mod recorder;
pub mod rollout;
pub mod server_location;
pub mod signals;
pub mod start;
pub mod status;
pub mod suite;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
pub mod usage;
