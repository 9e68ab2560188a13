//! What a run is, without starting one: its plan and its directory, what it needs of the machine, its records, and what its
//! policies do.

pub mod analysis;
pub mod description;
pub mod evaluation;
pub mod external_environment;
pub mod final_evaluation;
pub mod numbers;
pub mod outcome;
pub mod plan;
pub mod preflight;
pub mod process;
pub mod rate;
pub mod recorder;
pub mod remote;
pub mod rollout;
pub mod signals;
pub mod status;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
