//! Slices that are read together in one sweep, aligned to cache lines.

use std::ops::{Deref, DerefMut};

/// `f32`s in a page of 4096 bytes.
pub const PAGE: usize = 1024;
/// `f32`s between the offsets within a page of two neighbouring positions: 512 bytes.
const STAGGER: usize = 128;

/// A slice of fixed length that starts on a cache line, at an offset within a page that its position determines.
///
/// Adam reads and writes five such slices in step. Without the alignment its vectors would straddle cache lines; with
/// equal offsets, loads would wait for unrelated stores. Together that makes the sweep more than twice as slow.
#[derive(Debug)]
pub struct Aligned {
    numbers: Vec<f32>,
    start: usize,
    length: usize,
    position: usize,
}

impl Aligned {
    /// `length` zeros. `position` (0 to 7) numbers the slices that are read together.
    pub fn zeros(length: usize, position: usize) -> Self {
        let numbers = vec![0.0; length + PAGE + STAGGER * position];
        // `align_offset` may find no offset. That would cost only speed.
        let start = numbers.as_ptr().align_offset(PAGE * size_of::<f32>()).min(PAGE) + STAGGER * position;
        Self {
            numbers,
            start,
            length,
            position,
        }
    }

    /// A copy of `numbers`.
    pub fn from_slice(numbers: &[f32], position: usize) -> Self {
        let mut aligned = Self::zeros(numbers.len(), position);
        aligned.copy_from_slice(numbers);
        aligned
    }
}

impl Clone for Aligned {
    fn clone(&self) -> Self {
        Self::from_slice(self, self.position)
    }
}

impl Deref for Aligned {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.numbers[self.start..][..self.length]
    }
}

impl DerefMut for Aligned {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.numbers[self.start..][..self.length]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positions_start_on_cache_lines_at_their_own_offsets() {
        let offset = |aligned: &Aligned| aligned.as_ptr() as usize % (PAGE * 4);
        for length in [1, 16, 121_901] {
            for position in 0..8 {
                let aligned = Aligned::zeros(length, position);
                assert_eq!((aligned.len(), offset(&aligned)), (length, 512 * position));
                assert_eq!(offset(&aligned.clone()), 512 * position);
            }
        }
    }

    #[test]
    fn a_copy_holds_the_same_numbers() {
        let mut aligned = Aligned::from_slice(&[1.0, 2.0, 3.0], 2);
        let copy = aligned.clone();
        aligned[1] = 5.0;
        assert_eq!(*copy, [1.0, 2.0, 3.0]);
        assert_eq!(*aligned, [1.0, 5.0, 3.0]);
    }
}
