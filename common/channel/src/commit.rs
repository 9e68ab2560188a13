//! What the learner has committed to the replay: the header of the replay file.
//!
//! The learner is the only writer. Actors and `status` map the header read-only and follow the commit record with a
//! [`CommitReader`]. Both sides take the layout from [`ReplayLayout::places`]. `docs/REPLAY_FORMAT.md` describes the
//! format.

mod layout;
mod mirror;
mod reader;
mod record;
mod words;

pub use layout::{Places, PreambleError, ReplayLayout, SLOTS, SYNCED};
pub use mirror::CommitMirror;
pub use reader::{CommitReader, OpenError};
pub use record::{ActorCommit, ChunkId, MAX_INCARNATION, Record};
pub use words::{Words, WritableWords};
