//! What survives a power loss: rows reach the disk first, then a record that says so.
//!
//! `fdatasync` and not `msync`: the kernel writes the pages dirtied through a mapping all the same, only those (5 s of
//! 700 rows of 44 bytes are 150 KB, whatever the file's size), and it needs no borrow of the mapping, so that it can run
//! on another thread while rows are sampled and appended.

use std::fs::File;
use std::io;

use shoal_common::commit::{Record, SYNCED};

use super::error::ReplayError;
use super::step::{WriteStep, observe, step_of_record};
use super::store::Replay;

/// The replay as it was at some moment, to be brought to the disk by any thread.
#[must_use = "nothing is synced before `run`"]
#[derive(Debug)]
pub struct PendingSync {
    file: File,
    record: Record,
}

/// The replay as it was at some moment, on the disk.
#[must_use = "the file does not say so before `finish_sync`"]
#[derive(Debug)]
pub struct SyncedRows {
    record: Record,
}

impl PendingSync {
    /// Waits until the disk has all of it. Slow (a disk's write cache is emptied): milliseconds, on a busy disk more.
    pub fn run(self) -> io::Result<SyncedRows> {
        self.file.sync_data()?;
        Ok(SyncedRows { record: self.record })
    }
}

impl Replay {
    /// Takes note of what is committed now, for `PendingSync::run` on another thread.
    pub fn start_sync(&self) -> Result<PendingSync, ReplayError> {
        let file = self.file.try_clone().map_err(|source| self.cannot_sync(source))?;
        Ok(PendingSync {
            file,
            record: self.record.clone(),
        })
    }

    /// Records in the file what has reached the disk. The record itself is on the disk after the next sync: a power loss
    /// before that falls back to the one before.
    pub fn finish_sync(&mut self, synced: SyncedRows) {
        // Two syncs may end in another order than they began.
        if synced.record.generation() <= self.synced_generation {
            return;
        }
        let hook = &mut self.hook;
        observe(hook, WriteStep::RowsSynced);
        let slot = self.places.slots[self.next_synced];
        synced
            .record
            .store(&mut self.words, slot, |step| observe(hook, step_of_record(step)));
        self.synced_generation = synced.record.generation();
        self.next_synced = if self.next_synced == SYNCED { SYNCED + 1 } else { SYNCED };
        observe(hook, WriteStep::SyncRecorded);
    }

    /// Brings all that is committed to the disk and waits: after this, a power loss leaves at least these rows (but for
    /// the oldest, which rows committed later have replaced).
    pub fn flush(&mut self) -> Result<(), ReplayError> {
        let synced = self.start_sync()?.run().map_err(|source| self.cannot_sync(source))?;
        self.finish_sync(synced);
        // The record that says so: one block.
        self.file.sync_data().map_err(|source| self.cannot_sync(source))
    }

    pub(super) fn cannot_sync(&self, source: io::Error) -> ReplayError {
        ReplayError::Io {
            path: self.path.clone(),
            doing: "sync",
            source,
        }
    }
}
