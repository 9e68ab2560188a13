//! What crosses a process boundary of Shoal, or is shared by every role.
//!
//! Its layers are packages, each of which imports those above it in this list:
//!
//! | package | what is in it |
//! | --- | --- |
//! | `shoal-base` | spaces, rows, reports, random streams, files that are whole or not there |
//! | `shoal-channel` | the typed channels, and the replay's commit record |
//! | `shoal-policy` | networks, and how everyone acts by a policy (imports `shoal-base` alone) |
//! | `shoal-common` | the algorithms' settings, the configuration, the run directory |

pub mod algorithms;
pub mod config;
pub mod evaluator_state;
pub mod run_dir;

pub use shoal_base::{durable, exit, file_lock, report, section, space, stop, stream, transition};
pub use shoal_channel as channel;
pub use shoal_channel::commit;
pub use shoal_policy as policy;
pub use shoal_policy::{network, policy_file};
