//! What the learner has committed to the replay, as every other process reads it: the header of the replay file.
//!
//! The learner is the only writer. Actors and `status` map the header read-only and follow the commit record with a
//! [`CommitReader`]; the layout both sides share is stated once, in [`ReplayLayout::places`]. `ARCHITECTURE.md`, "The
//! replay file", explains the whole.

mod layout;
mod reader;
mod record;
mod words;

pub use layout::{IdentityFault, Places, ReplayLayout, SLOTS, SYNCED};
pub use reader::{CommitReader, OpenError};
pub use record::{ActorCommit, ChunkMark, LAST_INCARNATION, Record};
pub use words::{Words, WritableWords};
