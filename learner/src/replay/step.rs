//! Where tests may stop the writer.

/// What the writer has just done to the file; for tests that stop it there.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum WriteStep {
    /// The header says up to which row the ring is being written.
    ReachSet,
    /// The chunk's rows up to the ring's end are copied.
    RowsBeforeWrap,
    /// All the chunk's rows are copied.
    Rows,
    /// The rows' checks are written: the chunk is complete, and not yet committed.
    Checks,
    /// The seal of the older commit record is broken.
    SealBroken,
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
    [WriteStep::SealBroken, WriteStep::RecordWritten, WriteStep::Sealed][step]
}

pub(super) fn observe(hook: &mut Option<Hook>, step: WriteStep) {
    if let Some(hook) = hook {
        hook(step);
    }
}
