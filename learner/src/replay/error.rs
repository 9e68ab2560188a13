//! Errors of the replay, split by what the caller does next.

use std::io;
use std::path::PathBuf;

use shoal_common::commit::ChunkMark;

/// Why a replay file was not made, opened or synced. Nothing was overwritten.
#[derive(Debug, thiserror::Error)]
pub enum ReplayError {
    /// `create` found a file: open it, or choose another run directory.
    #[error("{0}: there is a replay already, and it is never overwritten; resume its run or choose another directory")]
    Exists(PathBuf),
    /// `open` found none.
    #[error("{0}: there is no replay; was the run ever started?")]
    Missing(PathBuf),
    /// Another process writes it: it has to end first.
    #[error("{0}: another learner is writing this replay; stop that run first")]
    InUse(PathBuf),
    /// The file is there and cannot be used.
    #[error(
        "{path}: the replay cannot be used: {reason}; the file was left as it is: resume with the run's own \
             configuration and program, or move the file away"
    )]
    Refused {
        /// The file.
        path: PathBuf,
        /// What differs or is damaged.
        reason: String,
    },
    /// No file can be of this layout.
    #[error("{path}: a replay of {ring} rows for {actors} actors cannot be made; choose another capacity")]
    Impossible {
        /// The file.
        path: PathBuf,
        /// Rows asked for.
        ring: u64,
        /// Actors asked for.
        actors: usize,
    },
    /// The space cannot be reserved.
    #[error(
        "{path}: the replay needs {bytes} bytes and there is no room for them: {source}; free some space, raise \
             the limit or make the replay's capacity smaller"
    )]
    NoSpace {
        /// The file.
        path: PathBuf,
        /// Bytes it would have.
        bytes: u64,
        /// The system's reason.
        source: io::Error,
    },
    /// The system refuses for another reason.
    #[error("{path}: cannot {doing} the replay: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// What failed, as a verb.
        doing: &'static str,
        /// The system's reason.
        source: io::Error,
    },
}

/// Why a chunk cannot be part of the replay, now or later: whoever sent it is wrong about the run. Nothing was written.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ChunkError {
    /// Its actor has no place in the commit record.
    #[error("a chunk of actor {actor} for a replay of {actors} actors")]
    Actor {
        /// The actor's index.
        actor: usize,
        /// How many there may be.
        actors: usize,
    },
    /// It is neither the next chunk of its actor nor the first one of the actor's next incarnation.
    #[error(
        "chunk {} of incarnation {} from actor {actor}, where chunk {} of incarnation {} was the last one: some are missing",
        mark.sequence, mark.incarnation, committed.sequence, committed.incarnation
    )]
    OutOfOrder {
        /// The actor's index.
        actor: usize,
        /// Which chunk it is.
        mark: ChunkMark,
        /// The actor's last committed one.
        committed: ChunkMark,
    },
    /// It ends within a row.
    #[error("a chunk of {numbers} numbers from actor {actor}, which are no whole rows of {width}")]
    Ragged {
        /// The actor's index.
        actor: usize,
        /// Numbers in the chunk.
        numbers: usize,
        /// Numbers in a row.
        width: usize,
    },
    /// It would overwrite itself.
    #[error("a chunk of {rows} rows from actor {actor} for a ring of {ring}")]
    TooLong {
        /// The actor's index.
        actor: usize,
        /// Rows in the chunk.
        rows: u64,
        /// Rows the ring has room for.
        ring: u64,
    },
}
