//! A batch of transitions as the matrices that a gradient step reads.

use std::ops::Range;

use nalgebra::{DMatrix, DVector};
use shoal_common::transition::{RowLayout, Transition};

use crate::replay::Replay;

/// N transitions (s, a, r, discount, s'), one column per sample.
#[derive(Clone, Debug, PartialEq)]
pub struct Minibatch {
    /// Observations s.
    pub s: DMatrix<f32>,
    /// Actions a, in environment units.
    pub a: DMatrix<f32>,
    /// Rewards r.
    pub r: DVector<f32>,
    /// The factor of the value of s': γ, or γᵏ after k steps, or 0 if s' is terminal.
    pub discount: DVector<f32>,
    /// Observations s' after the step.
    pub s_next: DMatrix<f32>,
}

impl Minibatch {
    /// `size` transitions, all zero.
    pub fn new(layout: RowLayout, size: usize) -> Self {
        Self {
            s: DMatrix::zeros(layout.observation_width(), size),
            a: DMatrix::zeros(layout.action_width(), size),
            r: DVector::zeros(size),
            discount: DVector::zeros(size),
            s_next: DMatrix::zeros(layout.observation_width(), size),
        }
    }

    /// The number of transitions.
    pub fn size(&self) -> usize {
        self.r.len()
    }

    /// Copies the rows with these numbers into the columns, from the first on. A row with a number that is not finite
    /// is replaced by the next good one of `range`. Panics if the replay does not hold one of the rows, or if there are
    /// more rows than columns.
    pub fn gather(&mut self, replay: &Replay, indices: &[u64], range: &Range<u64>) {
        // Random rows are cache misses. Both ends of all rows are read before any is copied, so that the misses
        // overlap; this is three times as fast. Both ends, because a row may lie on two cache lines.
        let ends = |row: &[f32]| row[0] + row[row.len() - 1];
        std::hint::black_box(indices.iter().map(|&index| ends(replay.row(index))).sum::<f32>());
        let layout = replay.layout().row;
        for (column, &index) in indices.iter().enumerate() {
            self.set(column, &layout.read(replay.finite_row(index, range)));
        }
    }

    /// Copies a transition into `column`. Panics if its widths are not the batch's, or if there is no such column.
    pub fn set(&mut self, column: usize, transition: &Transition<'_>) {
        copy_into_column(&mut self.s, column, transition.s);
        copy_into_column(&mut self.a, column, transition.a);
        self.r[column] = transition.r;
        self.discount[column] = transition.discount;
        copy_into_column(&mut self.s_next, column, transition.s_next);
    }
}

fn copy_into_column(matrix: &mut DMatrix<f32>, column: usize, numbers: &[f32]) {
    let rows = matrix.nrows();
    matrix.as_mut_slice()[column * rows..][..rows].copy_from_slice(numbers);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replay::{ChunkId, ReplayLayout};

    fn layout() -> ReplayLayout {
        ReplayLayout {
            row: RowLayout::new(2, 1),
            ring: 5,
            actors: 1,
            actor_snapshot_words: 0,
            fingerprint: 0,
        }
    }

    /// A replay that holds these rows, and the directory of its file.
    fn replay_of(rows: &[f32]) -> (tempfile::TempDir, Replay) {
        let directory = tempfile::tempdir().unwrap();
        let mut replay = Replay::create(&directory.path().join("replay"), &layout()).unwrap();
        let id = ChunkId {
            incarnation: 0,
            sequence: 1,
        };
        replay.append_and_commit(0, id, rows).unwrap();
        (directory, replay)
    }

    #[test]
    fn a_transition_becomes_a_column() {
        let mut batch = Minibatch::new(RowLayout::new(2, 1), 3);
        let transition = Transition {
            s: &[1.0, 2.0],
            a: &[3.0],
            r: 4.0,
            discount: 0.99,
            s_next: &[5.0, 6.0],
            last: false,
        };
        batch.set(1, &transition);
        assert_eq!(batch.s, DMatrix::from_row_slice(2, 3, &[0.0, 1.0, 0.0, 0.0, 2.0, 0.0]));
        assert_eq!(batch.a.as_slice(), [0.0, 3.0, 0.0]);
        assert_eq!(batch.r.as_slice(), [0.0, 4.0, 0.0]);
        assert_eq!(batch.discount.as_slice(), [0.0, 0.99, 0.0]);
        assert_eq!(
            batch.s_next,
            DMatrix::from_row_slice(2, 3, &[0.0, 5.0, 0.0, 0.0, 6.0, 0.0])
        );
    }

    #[test]
    fn rows_of_the_replay_become_columns_in_the_order_asked_for() {
        let layout = layout();
        let rows: Vec<f32> = (0..4 * layout.row.width()).map(|i| i as f32).collect();
        let (_directory, replay) = replay_of(&rows);
        let (mut gathered, mut expected) = (Minibatch::new(layout.row, 3), Minibatch::new(layout.row, 3));
        gathered.gather(&replay, &[3, 0, 3], &replay.rows());
        for (column, row) in [3, 0, 3].into_iter().enumerate() {
            expected.set(
                column,
                &layout.row.read(&rows[row * layout.row.width()..][..layout.row.width()]),
            );
        }
        assert_eq!(gathered, expected);
    }

    #[test]
    fn a_row_with_a_number_that_is_not_finite_is_replaced_by_the_next_good_one() {
        let layout = layout();
        let width = layout.row.width();
        let mut rows: Vec<f32> = (0..4 * width).map(|i| i as f32).collect();
        rows[width] = f32::NAN;
        rows[4 * width - 2] = f32::INFINITY;
        let (_directory, replay) = replay_of(&rows);
        let (mut gathered, mut expected) = (Minibatch::new(layout.row, 4), Minibatch::new(layout.row, 4));
        gathered.gather(&replay, &[0, 1, 2, 3], &replay.rows());
        for (column, row) in [0, 2, 2, 0].into_iter().enumerate() {
            expected.set(column, &layout.row.read(&rows[row * width..][..width]));
        }
        assert_eq!(gathered, expected, "after the last row the first follows");
    }
}
