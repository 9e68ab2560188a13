//! A batch of transitions as the matrices an update reads.

use nalgebra::{DMatrix, DVector};
use shoal_common::transition::{RowLayout, Transition};

/// N transitions (s, a, r, discount, s'), one column a sample.
#[derive(Clone, Debug, PartialEq)]
pub struct Minibatch {
    /// Observations s.
    pub s: DMatrix<f32>,
    /// Actions a, in environment units.
    pub a: DMatrix<f32>,
    /// Rewards r.
    pub r: DVector<f32>,
    /// What the value of s' counts for: γⁿ, or 0 where s' is terminal.
    pub discount: DVector<f32>,
    /// Observations s' after the step.
    pub s_next: DMatrix<f32>,
}

impl Minibatch {
    /// Room for `size` transitions, all zero.
    pub fn new(layout: RowLayout, size: usize) -> Self {
        Self {
            s: DMatrix::zeros(layout.observation_width(), size),
            a: DMatrix::zeros(layout.action_width(), size),
            r: DVector::zeros(size),
            discount: DVector::zeros(size),
            s_next: DMatrix::zeros(layout.observation_width(), size),
        }
    }

    /// How many transitions it holds.
    pub fn size(&self) -> usize {
        self.r.len()
    }

    /// Copies a transition into `column`. Panics when it has other widths than the batch, or there is no such column.
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
}
