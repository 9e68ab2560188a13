//! The replay: a ring of rows in a mapped file. Only the learner writes it, and it samples rows in place.
//!
//! Rows are numbered in the order they are committed, from 0, for the life of the file. A chunk becomes part of the
//! replay in three steps that cannot be taken out of order: [`Replay::reserve`], [`ReservedChunk::fill`],
//! [`FilledChunk::commit`]. A process that is killed between any two instructions leaves the last committed state.
//! `docs/REPLAY_FORMAT.md` has the layout, the invariants and what survives a power loss.
//!
//! ```
//! use shoal_common::transition::{RowLayout, Transition};
//! use shoal_learner::replay::{Appended, ChunkId, Replay, ReplayLayout};
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let row = RowLayout::new(2, 1); // two numbers of an observation, one of an action
//! let layout = ReplayLayout { row, ring: 100, actors: 1, actor_snapshot_words: 0, fingerprint: 0 };
//! let directory = tempfile::tempdir()?;
//! let mut replay = Replay::create(&directory.path().join("replay.bin"), &layout)?;
//!
//! let (s, a, s_next) = ([0.0, 1.0], [0.5], [0.1, 0.9]);
//! let transition = Transition { s: &s, a: &a, r: -1.0, discount: 0.99, s_next: &s_next, last: false };
//! let mut chunk = vec![0.0; row.width()]; // of one row
//! row.write(&transition, &mut chunk);
//! // A new process of an actor begins with an empty chunk, which tells its incarnation.
//! let first = ChunkId { incarnation: 1, sequence: 0 };
//! assert_eq!(replay.append_and_commit(0, first, &[])?, Appended::Accepted);
//! let id = ChunkId { sequence: 1, ..first };
//! assert_eq!(replay.append_and_commit(0, id, &chunk)?, Appended::Accepted);
//! // After a crash a chunk may arrive again.
//! assert_eq!(replay.append_and_commit(0, id, &chunk)?, Appended::Duplicate);
//! assert_eq!(replay.rows(), 0..1);
//! assert_eq!(row.read(replay.row(0)).r, -1.0);
//! # Ok(())
//! # }
//! ```

mod append;
mod check;
mod error;
mod file;
mod initial_rows;
mod recovery;
mod ring;
mod step;
mod store;
mod sync;

pub use shoal_common::commit::{ActorCommit, ChunkId, ReplayLayout};

pub use self::append::{Appended, FilledChunk, ReservedChunk};
pub use self::error::{ChunkError, ReplayError};
pub(crate) use self::file::unfinished_bytes;
pub use self::step::WriteStep;
pub use self::store::Replay;
pub use self::sync::{PendingSync, SyncedRows};
