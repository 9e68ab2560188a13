//! The mapped rows and their checks. Only this module accesses the file as ordinary memory.

use std::fs::File;
use std::io;
use std::ops::Range;

use memmap2::{MmapMut, MmapOptions};
use shoal_common::commit::{FileOffsets, ReplayLayout};

use super::check;
use super::step::WriteStep;

/// The places of the ring. Row `index` is stored in place `index` mod `ring`.
pub(super) struct Ring {
    map: MmapMut,
    /// Where the rows begin in the mapping, in bytes; the checks begin at 0.
    rows: usize,
    ring: u64,
    width: usize,
}

impl Ring {
    /// Maps checks and rows of a file whose length has been compared with its layout.
    pub(super) fn map(file: &File, layout: &ReplayLayout, offsets: &FileOffsets) -> io::Result<Self> {
        let mut options = MmapOptions::new();
        options
            .offset(offsets.checks.start as u64)
            .len(offsets.end - offsets.checks.start);
        // SAFETY: the bytes change under a mapping only if another process writes the file. Rows and checks are written
        // and read only by the process that holds the file's lock, which is this one, and only through this mapping.
        // Other processes map the header, which ends before it. The file is never shortened: its space was reserved
        // when it was created, and its length has been checked.
        let map = unsafe { options.map_mut(file)? };
        let rows = offsets.rows.start - offsets.checks.start;
        Ok(Self {
            map,
            rows,
            ring: layout.ring,
            width: layout.row.width(),
        })
    }

    fn place(&self, index: u64) -> usize {
        // A place is less than the ring's length, which fits in `usize`: the file was mapped.
        (index % self.ring) as usize
    }

    #[inline]
    pub(super) fn row(&self, index: u64) -> &[f32] {
        let start = self.place(index) * self.width;
        &bytemuck::cast_slice(&self.map[self.rows..])[start..start + self.width]
    }

    fn parts(&mut self) -> (&mut [u32], &mut [f32]) {
        let (checks, rows) = self.map.split_at_mut(self.rows);
        (bytemuck::cast_slice_mut(checks), bytemuck::cast_slice_mut(rows))
    }

    /// Writes rows `first ..`, at most a ring of them, and then their checks.
    pub(super) fn put(&mut self, first: u64, numbers: &[f32], mut step: impl FnMut(WriteStep)) {
        let (start, places, width) = (self.place(first), self.ring as usize, self.width);
        let (checks, rows) = self.parts();
        let (before, after) = numbers.split_at(numbers.len().min((places - start) * width));
        rows[start * width..][..before.len()].copy_from_slice(before);
        step(WriteStep::RowsBeforeWrap);
        rows[..after.len()].copy_from_slice(after);
        step(WriteStep::Rows);
        let (before, after) = (before.chunks_exact(width), after.chunks_exact(width));
        let wrapped = first + before.len() as u64;
        for ((check, row), index) in checks[start..].iter_mut().zip(before).zip(first..) {
            *check = check::of_row(index, row);
        }
        for ((check, row), index) in checks.iter_mut().zip(after).zip(wrapped..) {
            *check = check::of_row(index, row);
        }
        step(WriteStep::Checks);
    }

    fn check(&self, index: u64) -> u32 {
        bytemuck::cast_slice::<_, u32>(&self.map[..self.rows])[self.place(index)]
    }

    /// Whether the ring holds exactly row `index`.
    pub(super) fn holds(&self, index: u64) -> bool {
        let check = self.check(index);
        check != check::NONE && check == check::of_row(index, self.row(index))
    }

    /// Empties the places outside `rows`. Otherwise a row that was never committed, or was given up after a power
    /// loss, could pass for the later row with its number. Returns true if a place was not empty.
    pub(super) fn clear_outside(&mut self, rows: Range<u64>) -> bool {
        let mut cleared = false;
        for index in rows.end..rows.start + self.ring {
            // Only the checks are read: reading the rows too would load a ring that is not full into memory.
            if self.check(index) != check::NONE {
                let place = self.place(index);
                self.parts().0[place] = check::NONE;
                cleared = true;
            }
        }
        cleared
    }
}
