//! The replay: a ring of rows in a mapped file. Only the learner writes it, and it samples rows in place.
//!
//! Rows are numbered in the order they are committed, from 0, for the life of the file. A chunk becomes part of the
//! replay in three steps that cannot be taken out of order: [`Replay::begin`], [`Reserved::fill`], [`Filled::commit`].
//! A process that is killed between any two instructions leaves the last committed state. `docs/REPLAY_FORMAT.md` has
//! the layout, the invariants and what survives a power loss.

mod append;
mod begin;
mod check;
mod error;
mod file;
mod recovery;
mod ring;
mod step;
mod store;
mod sync;

pub use shoal_common::commit::{ActorCommit, ChunkMark, ReplayLayout};

pub use self::append::{Appended, Filled, Reserved};
pub use self::error::{ChunkError, ReplayError};
pub use self::step::WriteStep;
pub use self::store::{Replay, are_finite};
pub use self::sync::{PendingSync, SyncedRows};
