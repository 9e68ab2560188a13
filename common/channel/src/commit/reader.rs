//! The reading side: what an actor and `status` see of the replay.

use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{Ordering, fence};

use super::layout::{IDENTITY_BYTES, Places, ReplayLayout};
use super::record::{self, ActorCommit, ChunkMark, Record};
use super::words::Words;

/// Follows the commit record of a replay file that a learner may be writing. Never waits for the learner, alive or dead.
#[derive(Debug)]
pub struct CommitReader {
    words: Words,
    places: Places,
    layout: ReplayLayout,
}

/// Why a replay's commit record cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The learner has not made the file yet, or has still to repair its record: try again later.
    #[error("{path}: {reason}; waiting for the learner")]
    NotYet {
        /// The replay file.
        path: PathBuf,
        /// What is missing.
        reason: &'static str,
    },
    /// The file is there and waiting will not make it readable.
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
        if length < IDENTITY_BYTES as u64 {
            return Err(refused("the file is too short for a replay".into()));
        }
        let identity = Words::map(&file, IDENTITY_BYTES).map_err(io)?;
        let layout = ReplayLayout::read(&identity).map_err(|fault| refused(fault.to_string()))?;
        let places = layout
            .places()
            .ok_or_else(|| refused("its header asks for an impossible size".into()))?;
        if length != places.end as u64 {
            return Err(refused(format!(
                "the file has {length} bytes, its header says {}",
                places.end
            )));
        }
        let words = Words::map(&file, places.header).map_err(io)?;
        let reader = Self { words, places, layout };
        // After a power loss the record may be damaged until the learner has opened the file: later reads trust it.
        if reader.snapshot().is_none() {
            return Err(not_yet("its commit record is damaged"));
        }
        Ok(reader)
    }

    /// What the file holds.
    pub fn layout(&self) -> &ReplayLayout {
        &self.layout
    }

    /// Rows ever committed.
    pub fn rows(&self) -> u64 {
        self.consistent(|slot| record::load_head(&self.words, slot))
    }

    /// The last chunk committed of an actor; the default mark before its first.
    ///
    /// # Panics
    /// As indexing a slice does: `actor` must be less than `layout().actors`.
    pub fn committed(&self, actor: usize) -> ChunkMark {
        self.actor(actor).mark
    }

    /// What is committed of an actor.
    ///
    /// # Panics
    /// As indexing a slice does: `actor` must be less than `layout().actors`.
    pub fn actor(&self, actor: usize) -> ActorCommit {
        assert!(
            actor < self.layout.actors,
            "actor {actor} of a replay for {}",
            self.layout.actors
        );
        self.consistent(|slot| record::load_actor(&self.words, slot, &self.layout, actor))
    }

    /// Where an actor stood after its last chunk, as it said it; zeros before the first.
    ///
    /// # Panics
    /// As indexing a slice does: `actor` must be less than `layout().actors`.
    pub fn standing(&self, actor: usize) -> Vec<u64> {
        self.snapshot().map_or_else(
            || vec![0; self.layout.actor_snapshot_words],
            |record| record.standing(actor).to_vec(),
        )
    }

    /// The whole record, all of one moment. `None` if it is damaged, which only the learner can repair.
    pub fn snapshot(&self) -> Option<Record> {
        self.consistent(|slot| Record::load(&self.words, slot, &self.layout))
    }

    /// Reads from the published slot until no other record was published meanwhile. The writer touches a slot only
    /// after it has published the other one, so two equal selectors prove that the slot was left alone between them.
    fn consistent<T>(&self, read: impl Fn(usize) -> T) -> T {
        loop {
            let generation = self.words.load(self.places.selector);
            // SYNC POINT with the last Release fence of `Record::store`, after which the learner published: the record
            // is complete.
            fence(Ordering::Acquire);
            let value = read(self.places.slots[(generation % 2) as usize]);
            // SYNC POINT with the first Release fence of `Record::store`: who has read a word of the next record but one
            // also sees that the selector has moved.
            fence(Ordering::Acquire);
            if self.words.load(self.places.selector) == generation {
                return value;
            }
            std::hint::spin_loop();
        }
    }
}
