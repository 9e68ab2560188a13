//! Everything that crosses a process boundary of Shoal, or is shared by all roles.
//!
//! Its layers are packages. Each imports the packages above it in this list:
//!
//! | package | contents |
//! | --- | --- |
//! | `shoal-base` | spaces, transitions, roles and their reports, random streams, files that are either complete or absent |
//! | `shoal-channel` | the typed channels, and the replay's commit record |
//! | `shoal-policy` | networks, and policies as actors and evaluator use them (imports `shoal-base` alone) |
//! | `shoal-common` | the algorithms' settings, the configuration, the run directory |

pub mod actor_snapshot;
pub mod algorithms;
pub mod config;
pub mod evaluator_state;
pub mod run_dir;

pub use shoal_base::{
    durable, exit, file_lock, message, numbers, report, role, section, space, stop, stream, transition, versioned_file,
};
pub use shoal_channel as channel;
pub use shoal_channel::commit;
pub use shoal_policy as policy;
pub use shoal_policy::{network, policy_file};
