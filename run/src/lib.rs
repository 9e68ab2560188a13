//! What surrounds a run's roles: its plan and directory, the resources it needs, its records, the evaluation of its
//! policies, and suites of runs.

pub mod child_process;
pub mod client;
pub(crate) mod demonstrations;
pub mod description;
pub mod evaluation;
pub mod external_environment;
pub mod files;
pub mod interrupted_start;
pub mod jobs;
pub mod joining;
pub mod numbers;
pub mod origin;
pub mod plan;
pub mod preflight;
pub mod python;
pub mod records;
pub mod signals;
pub mod status;
pub mod suite;
#[cfg(any(test, feature = "testing"))]
pub mod testing;
pub mod usage;
