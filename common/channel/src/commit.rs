//! What the learner has committed to the replay: the header of the replay file.
//!
//! The learner is the only writer, except that the launcher makes the first replay of a run that begins with another
//! run or a dataset. On another host the relay writes a copy of the header with a [`CommitMirror`]. Actors and `status`
//! map the header read-only and follow the commit record with a [`CommitReader`]. All of them take the layout from
//! [`ReplayLayout::offsets`]. `docs/REPLAY_FORMAT.md` describes the format.

mod layout;
mod mirror;
mod reader;
mod record;
mod words;

pub use layout::{FileOffsets, MAX_ACTOR_SNAPSHOT_WORDS, PreambleError, ReplayLayout, SLOTS, SYNCED};
pub use mirror::CommitMirror;
pub use reader::{CommitReader, OpenError};
pub use record::{ActorCommit, ChunkId, CommitRecord, MAX_INCARNATION};
pub use words::{Words, WritableWords};
