//! The steps after which tests can stop the writer.

/// A step that the writer has just finished. Tests stop it there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum WriteStep {
    /// The write horizon in the header covers the chunk.
    WriteHorizonSet,
    /// The chunk's rows up to the ring's end are copied.
    RowsBeforeWrap,
    /// All the chunk's rows are copied.
    Rows,
    /// The rows' checks are written: the chunk is complete, and not yet committed.
    Checks,
    /// The seal of the older commit record is cleared.
    SealCleared,
    /// The new commit record is written over it.
    RecordWritten,
    /// The new record is sealed: a learner that opens the file now finds the chunk committed.
    Sealed,
    /// The readers see the new record.
    Published,
    /// Rows and records are on the disk.
    RowsSynced,
    /// The record of what is on the disk is written.
    SyncRecorded,
}

pub(super) type Hook = Box<dyn FnMut(WriteStep) + Send>;

pub(super) fn step_of_record(step: usize) -> WriteStep {
    [WriteStep::SealCleared, WriteStep::RecordWritten, WriteStep::Sealed][step]
}

pub(super) fn observe(hook: &mut Option<Hook>, step: WriteStep) {
    if let Some(hook) = hook {
        hook(step);
    }
}
