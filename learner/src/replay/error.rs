//! Errors of the replay, separated by what the caller does next.

use std::io;
use std::path::PathBuf;

use shoal_common::commit::ChunkId;

/// Why a replay file was not created, opened or synced. Nothing was overwritten.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// `create` found a file: open it, or choose another run directory.
    #[error("{0}: a replay exists already and is never overwritten; resume its run or choose another directory")]
    Exists(PathBuf),
    /// `open` found none.
    #[error("{0}: there is no replay; was the run ever started?")]
    Missing(PathBuf),
    /// Another process writes it and must end first.
    #[error("{0}: another learner is writing this replay; stop that run first")]
    InUse(PathBuf),
    /// The file exists but cannot be used.
    #[error(
        "{path}: the replay cannot be used: {reason}; the file was left as it is: resume with the run's own \
             configuration and program, or move the file away"
    )]
    Refused {
        /// The replay file.
        path: PathBuf,
        /// What differs or is damaged.
        reason: String,
    },
    /// No file can have this layout.
    #[error("{path}: a replay of {ring} rows for {actors} actors cannot be made; choose another capacity")]
    Impossible {
        /// The replay file.
        path: PathBuf,
        /// Rows asked for.
        ring: u64,
        /// Actors asked for.
        actors: usize,
    },
    /// The space cannot be reserved.
    #[error(
        "{path}: the replay needs {bytes} bytes and there is not enough space: {source}; free some space, raise \
             the limit or reduce the replay's capacity"
    )]
    NoSpace {
        /// The replay file.
        path: PathBuf,
        /// Bytes it would have.
        bytes: u64,
        /// The system's reason.
        source: io::Error,
    },
    /// The system reports another error.
    #[error("{path}: cannot {action} the replay: {source}")]
    Io {
        /// The replay file.
        path: PathBuf,
        /// What failed, as a verb.
        action: &'static str,
        /// The system's reason.
        source: io::Error,
    },
}

/// Why a chunk can never be part of the replay: its sender disagrees with the learner about the run. Nothing was
/// written.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChunkError {
    /// The commit record has no such actor.
    #[error("a chunk from actor {actor}, but the replay has {actors} actors")]
    Actor {
        /// The actor's index.
        actor: usize,
        /// How many actors the replay has.
        actors: usize,
    },
    /// It is neither the next chunk of its actor nor the first one of the actor's next incarnation.
    #[error(
        "chunk {} of incarnation {} from actor {actor} after chunk {} of incarnation {}: some between them are missing",
        id.sequence, id.incarnation, committed.sequence, committed.incarnation
    )]
    OutOfOrder {
        /// The actor's index.
        actor: usize,
        /// The chunk's id.
        id: ChunkId,
        /// The id of the actor's last committed chunk.
        committed: ChunkId,
    },
    /// It ends within a row.
    #[error(
        "a chunk of {numbers} numbers from actor {actor}, which is not a multiple of {width}, the numbers in a row"
    )]
    Ragged {
        /// The actor's index.
        actor: usize,
        /// Numbers in the chunk.
        numbers: usize,
        /// Numbers in a row.
        width: usize,
    },
    /// It would overwrite itself.
    #[error("a chunk of {rows} rows from actor {actor}, but the ring has {ring}")]
    TooLong {
        /// The actor's index.
        actor: usize,
        /// Rows in the chunk.
        rows: u64,
        /// Rows in the ring.
        ring: u64,
    },
}
