//! The reading side, for actors and `shoal status`.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{Ordering, fence};

use super::layout::{FileOffsets, PREAMBLE_BYTES, ReplayLayout};
use super::record::{self, ActorCommit, ChunkId, CommitRecord};
use super::words::Words;

/// Follows the commit record of a replay file that a learner may be writing. It never waits for the learner, alive or
/// dead.
#[derive(Debug)]
pub struct CommitReader {
    words: Words,
    offsets: FileOffsets,
    layout: ReplayLayout,
}

/// Why a replay's commit record cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The learner has not created the file yet, or must repair its record first: try again later.
    #[error("{path}: {reason}; waiting for the learner")]
    NotYet {
        /// The replay file.
        path: PathBuf,
        /// What is missing.
        reason: &'static str,
    },
    /// The file exists, and waiting will not make it readable.
    #[error("{path}: {reason}; the file was left as it is: move it away, or use the program that wrote it")]
    Refused {
        /// The replay file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The system refuses to open or map the file.
    #[error("{path}: cannot map the replay: {source}")]
    Io {
        /// The replay file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

impl CommitReader {
    /// Maps the header of the replay at `path`, read-only.
    pub fn open(path: &Path) -> Result<Self, OpenError> {
        let io = |source| OpenError::Io {
            path: path.into(),
            source,
        };
        let refused = |reason| OpenError::Refused {
            path: path.into(),
            reason,
        };
        let not_yet = |reason| OpenError::NotYet {
            path: path.into(),
            reason,
        };
        let file = match File::open(path) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Err(not_yet("there is no replay yet")),
            file => file.map_err(io)?,
        };
        let length = file.metadata().map_err(io)?.len();
        if length < PREAMBLE_BYTES as u64 {
            return Err(refused("the file is too short for a replay".into()));
        }
        let preamble = Words::map(&file, PREAMBLE_BYTES).map_err(io)?;
        let layout = ReplayLayout::read(&preamble).map_err(|fault| refused(fault.to_string()))?;
        let offsets = layout
            .offsets()
            .ok_or_else(|| refused("its header has an impossible size".into()))?;
        if length != offsets.end as u64 {
            return Err(refused(format!(
                "the file has {length} bytes, its header requires {}",
                offsets.end
            )));
        }
        let words = Words::map(&file, offsets.header).map_err(io)?;
        let reader = Self { words, offsets, layout };
        // Later reads trust the record. After a power loss it may be damaged until the learner has opened the file.
        if reader.snapshot().is_none() {
            return Err(not_yet("its commit record is damaged"));
        }
        Ok(reader)
    }

    /// As [`open`](Self::open), but `None` while the learner has not created the file, or must repair its record first.
    ///
    /// # Errors
    /// When waiting for the learner does not help.
    pub fn open_if_ready(path: &Path) -> Result<Option<Self>, OpenError> {
        match Self::open(path) {
            Ok(reader) => Ok(Some(reader)),
            Err(OpenError::NotYet { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    /// The file's layout.
    pub fn layout(&self) -> &ReplayLayout {
        &self.layout
    }

    /// Rows committed over the life of the file.
    pub fn rows(&self) -> u64 {
        self.consistent(|slot| record::load_head(&self.words, slot))
    }

    /// The id of an actor's last committed chunk; the default id before its first.
    ///
    /// # Panics
    /// If `actor` is not less than `layout().actors`.
    pub fn committed(&self, actor: usize) -> ChunkId {
        self.actor(actor).last_chunk
    }

    /// What is committed of an actor.
    ///
    /// # Panics
    /// If `actor` is not less than `layout().actors`.
    pub fn actor(&self, actor: usize) -> ActorCommit {
        assert!(
            actor < self.layout.actors,
            "actor {actor} of a replay for {}",
            self.layout.actors
        );
        self.consistent(|slot| record::load_actor(&self.words, slot, &self.layout, actor))
    }

    /// An actor's snapshot after its last committed chunk; zeros before the first.
    ///
    /// # Panics
    /// If `actor` is not less than `layout().actors`.
    pub fn actor_snapshot(&self, actor: usize) -> Vec<u64> {
        self.snapshot().map_or_else(
            || vec![0; self.layout.actor_snapshot_words],
            |record| record.actor_snapshot(actor).to_vec(),
        )
    }

    /// A consistent copy of the whole record. `None` if it is damaged; only the learner can repair it.
    pub fn snapshot(&self) -> Option<CommitRecord> {
        self.consistent(|slot| CommitRecord::load(&self.words, slot, &self.layout))
    }

    /// Reads from the active slot, and repeats if another record was published in between. The writer changes a slot
    /// only after it has published the other one. So if the published generation is the same before and after the read,
    /// the slot was not touched.
    fn consistent<T>(&self, read: impl Fn(usize) -> T) -> T {
        loop {
            let generation = self.words.load(self.offsets.published);
            // SYNC POINT with the last Release fence of `CommitRecord::store`, after which the learner published the
            // generation: the record is complete.
            fence(Ordering::Acquire);
            let value = read(self.offsets.slots[(generation % 2) as usize]);
            // SYNC POINT with the first Release fence of `CommitRecord::store`: if `read` has seen a word of a later
            // record in this slot, the load below sees a newer generation.
            fence(Ordering::Acquire);
            if self.words.load(self.offsets.published) == generation {
                return value;
            }
            std::hint::spin_loop();
        }
    }
}
