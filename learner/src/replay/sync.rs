//! Syncing for a power loss: first the rows reach the disk, then a record that names them.
//!
//! `fdatasync` also writes the pages that were changed through the mapping, and only those. Unlike `msync` it needs no
//! borrow of the mapping, so it can run on another thread while rows are sampled and appended.

use std::fs::File;
use std::io;

use shoal_common::commit::{CommitRecord, SYNCED};

use super::error::ReplayError;
use super::step::{WriteStep, observe, step_of_record};
use super::store::Replay;

/// The replay as it was at one moment, to be synced by any thread.
#[must_use = "nothing is synced before `run`"]
#[derive(Debug)]
pub struct PendingSync {
    file: File,
    record: CommitRecord,
}

/// The replay as it was at one moment, now on the disk.
#[must_use = "the file does not record this before `finish_sync`"]
#[derive(Debug)]
pub struct SyncedRows {
    record: CommitRecord,
}

impl PendingSync {
    /// Syncs the file and waits until the disk has all of it. This takes milliseconds, on a busy disk more, because the
    /// disk's write cache is flushed.
    pub fn run(self) -> io::Result<SyncedRows> {
        self.file.sync_data()?;
        Ok(SyncedRows { record: self.record })
    }
}

impl Replay {
    /// Copies the record of what is committed now, for `PendingSync::run` on another thread.
    pub fn start_sync(&self) -> Result<PendingSync, ReplayError> {
        let file = self.file.try_clone().map_err(|source| self.cannot_sync(source))?;
        Ok(PendingSync {
            file,
            record: self.record.clone(),
        })
    }

    /// Records in the file what has reached the disk. This record reaches the disk with the next sync; after a power
    /// loss before that, recovery falls back to the previous one.
    pub fn finish_sync(&mut self, synced: SyncedRows) {
        // Two syncs may end in a different order than they began.
        if synced.record.generation() <= self.synced_generation {
            return;
        }
        let hook = &mut self.hook;
        observe(hook, WriteStep::RowsSynced);
        let slot = self.offsets.slots[self.next_synced];
        synced
            .record
            .store(&mut self.words, slot, |step| observe(hook, step_of_record(step)));
        self.synced_generation = synced.record.generation();
        self.next_synced = if self.next_synced == SYNCED { SYNCED + 1 } else { SYNCED };
        observe(hook, WriteStep::SyncRecorded);
    }

    /// Syncs everything that is committed and waits. After this, a power loss leaves at least these rows, except the
    /// oldest ones that later rows have replaced.
    pub fn flush(&mut self) -> Result<(), ReplayError> {
        let synced = self.start_sync()?.run().map_err(|source| self.cannot_sync(source))?;
        self.finish_sync(synced);
        // Syncs the record too, which is one block.
        self.file.sync_data().map_err(|source| self.cannot_sync(source))
    }

    pub(super) fn cannot_sync(&self, source: io::Error) -> ReplayError {
        ReplayError::Io {
            path: self.path.clone(),
            action: "sync",
            source,
        }
    }
}
