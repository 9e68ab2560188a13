//! The replay of the writer: the mapped file, its ring of rows and its record.

use std::fs::File;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering, compiler_fence};

use shoal_common::commit::{ActorCommit, CommitRecord, FileOffsets, ReplayLayout, WritableWords};
use shoal_common::numbers::are_finite;

use super::error::ReplayError;
use super::ring::Ring;
use super::step::{Hook, WriteStep, observe, step_of_record};
use super::{file, recovery};

/// The replay of a run, with the right to write its file: a second one is refused while this one exists.
pub struct Replay {
    pub(super) path: PathBuf,
    pub(super) layout: ReplayLayout,
    pub(super) offsets: FileOffsets,
    pub(super) file: File,
    pub(super) words: WritableWords,
    pub(super) ring: Ring,
    /// What is committed, as in the active slot, except that the tail already excludes the rows that the chunk being
    /// filled overwrites.
    pub(super) record: CommitRecord,
    /// Which of the two slots for synced records is written next.
    pub(super) next_synced: usize,
    /// The newest generation in these two slots.
    pub(super) synced_generation: u64,
    pub(super) warnings: Vec<String>,
    pub(super) hook: Option<Hook>,
    /// Whether it has been logged that some rows are not learned from.
    warned: AtomicBool,
}

impl Replay {
    /// Creates the replay of a new run, with all its space reserved. Never replaces a file, and leaves none after an
    /// error.
    pub fn create(path: &Path, layout: &ReplayLayout) -> Result<Self, ReplayError> {
        let (file, offsets) = file::create(path, layout)?;
        Self::map(path, layout, offsets, file)
    }

    /// Maps the replay of a run that is resumed, and repairs it after a crash (see `warnings`). A file of another
    /// layout or configuration is refused and left as it is.
    pub fn open(path: &Path, layout: &ReplayLayout) -> Result<Self, ReplayError> {
        let (file, offsets) = file::open(path, layout)?;
        Self::map(path, layout, offsets, file)
    }

    fn map(path: &Path, layout: &ReplayLayout, offsets: FileOffsets, file: File) -> Result<Self, ReplayError> {
        let io = |source| ReplayError::Io {
            path: path.into(),
            action: "map",
            source,
        };
        let words = WritableWords::map(&file, offsets.header).map_err(io)?;
        let ring = Ring::map(&file, layout, &offsets).map_err(io)?;
        let found =
            recovery::recover(words.read(), &offsets, layout, &ring).map_err(|reason| ReplayError::Refused {
                path: path.into(),
                reason,
            })?;
        let mut replay = Self {
            path: path.into(),
            layout: layout.clone(),
            offsets,
            file,
            words,
            ring,
            record: found.record,
            next_synced: found.next_synced,
            synced_generation: found.synced_generation,
            warnings: found.warnings,
            hook: None,
            warned: AtomicBool::new(false),
        };
        replay.words.store(replay.offsets.published, found.first_generation);
        replay.publish(found.next_generation);
        replay.words.store(replay.offsets.write_horizon, replay.record.head());
        let cleared = replay.ring.clear_outside(replay.rows());
        if cleared || !replay.warnings.is_empty() {
            // A later power loss must not bring back the rows that were given up here.
            replay.file.sync_data().map_err(|source| replay.cannot_sync(source))?;
        }
        Ok(replay)
    }

    /// What was lost or repaired when the file was opened, one line each, for the run's log. A mere `kill -9` leaves it
    /// empty.
    pub fn warnings(&self) -> &[String] {
        &self.warnings
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The layout of the file.
    pub fn layout(&self) -> &ReplayLayout {
        &self.layout
    }

    /// The number of rows ever committed, which is the number of the next row.
    pub fn head(&self) -> u64 {
        self.record.head()
    }

    /// The rows that can be read.
    pub fn rows(&self) -> Range<u64> {
        self.record.tail()..self.record.head()
    }

    /// What is committed of an actor.
    ///
    /// # Panics
    /// Unless `actor` is less than the layout's `actors`.
    pub fn committed(&self, actor: usize) -> ActorCommit {
        self.record.actor(actor)
    }

    /// A row, in place.
    ///
    /// # Panics
    /// Unless `index` is in `rows()`.
    #[inline]
    pub fn row(&self, index: u64) -> &[f32] {
        let rows = self.rows();
        assert!(
            rows.contains(&index),
            "row {index} is not in the replay, which holds the rows {rows:?}"
        );
        self.ring.row(index)
    }

    /// Row `index` if its numbers are all finite. Otherwise the next finite row of `within`, continuing at its
    /// beginning after its end; row `index` itself if there is none. Only replays of earlier versions can hold rows
    /// that are not finite: a learner checks chunks before it commits them.
    ///
    /// # Panics
    /// As [`row`](Self::row).
    #[inline]
    pub fn finite_row(&self, index: u64, within: &Range<u64>) -> &[f32] {
        let row = self.row(index);
        if are_finite(row) {
            row
        } else {
            self.next_finite_row(index, within)
        }
    }

    #[cold]
    fn next_finite_row(&self, index: u64, within: &Range<u64>) -> &[f32] {
        if !self.warned.swap(true, Ordering::Relaxed) {
            let path = self.path.display();
            tracing::warn!("{path}: row {index} holds a number that is not finite; such rows are not learned from");
        }
        let mut others = (index + 1..within.end)
            .chain(within.start..index)
            .map(|other| self.row(other));
        others.find(|row| are_finite(row)).unwrap_or_else(|| self.row(index))
    }

    /// The rows to draw a minibatch from, for a replay as it was after `rows` rows: the newest `capacity` of them.
    /// There are fewer if the replay had fewer, if rows were lost, or if the ring has overwritten some since. A caller
    /// that must rule out the last case compares the start with `rows - capacity`.
    pub fn sampling_range(&self, rows: u64, capacity: u64) -> Range<u64> {
        let readable = self.rows();
        let end = rows.clamp(readable.start, readable.end);
        end.saturating_sub(capacity).max(readable.start)..end
    }

    /// Calls `hook` after each step of every later write, for crash tests.
    pub fn on_step(&mut self, hook: impl FnMut(WriteStep) + Send + 'static) {
        self.hook = Some(Box::new(hook));
    }

    /// Writes `self.record` into the slot of `generation` and makes it the active slot.
    pub(super) fn publish(&mut self, generation: u64) {
        let published = self.words.read().load(self.offsets.published);
        assert_ne!(generation % 2, published % 2, "the active slot is never written");
        self.record.set_generation(generation);
        let slot = self.offsets.slots[(generation % 2) as usize];
        let hook = &mut self.hook;
        self.record
            .store(&mut self.words, slot, |step| observe(hook, step_of_record(step)));
        // SYNC POINT with the first Acquire fence of `CommitReader::consistent`. The Release fence is the last one of
        // `CommitRecord::store`.
        self.words.store(self.offsets.published, generation);
        // After a kill, the file has the stores in program order, as compiled. This fence keeps the compiler from
        // moving the next chunk's rows, which are plain stores, before this store.
        compiler_fence(Ordering::SeqCst);
        observe(hook, WriteStep::Published);
    }
}

impl std::fmt::Debug for Replay {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Replay")
            .field("path", &self.path)
            .field("rows", &self.rows())
            .finish_non_exhaustive()
    }
}
