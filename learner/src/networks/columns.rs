//! Matrices whose columns are contiguous slices by construction, so that a sweep over a column needs no check.

use faer::{MatMut, MatRef};

/// A range of rows of a column-major matrix.
#[derive(Clone, Copy, Debug)]
pub(super) struct Columns<'a> {
    numbers: &'a [f32],
    /// Rows of the whole matrix.
    stride: usize,
    first: usize,
    rows: usize,
}

impl<'a> Columns<'a> {
    /// A matrix with `rows` rows, at least one. `numbers` are whole columns.
    pub(super) fn new(numbers: &'a [f32], rows: usize) -> Self {
        Self {
            numbers,
            stride: rows,
            first: 0,
            rows,
        }
    }

    /// `rows` rows, from `first` on. Panics if there are fewer.
    pub(super) fn rows(self, first: usize, rows: usize) -> Self {
        assert!(first + rows <= self.rows, "rows of a matrix");
        Self {
            first: self.first + first,
            rows,
            ..self
        }
    }

    /// Every column.
    pub(super) fn iter(self) -> impl Iterator<Item = &'a [f32]> {
        let Self { first, rows, .. } = self;
        self.numbers
            .chunks_exact(self.stride)
            .map(move |column| &column[first..][..rows])
    }

    /// The matrix for products.
    pub(super) fn as_mat(self) -> MatRef<'a, f32> {
        MatRef::from_column_major_slice(self.numbers, self.stride, self.numbers.len() / self.stride)
            .subrows(self.first, self.rows)
    }
}

/// A mutable column-major matrix. It may have no rows.
#[derive(Debug)]
pub(super) struct ColumnsMut<'a> {
    numbers: &'a mut [f32],
    rows: usize,
    columns: usize,
}

impl<'a> ColumnsMut<'a> {
    /// The first `rows · columns` of `numbers` as a matrix, and the numbers behind them.
    pub(super) fn take(numbers: &'a mut [f32], rows: usize, columns: usize) -> (Self, &'a mut [f32]) {
        let (numbers, rest) = numbers.split_at_mut(rows * columns);
        let matrix = Self { numbers, rows, columns };
        (matrix, rest)
    }

    /// Every column.
    pub(super) fn iter_mut(&mut self) -> impl Iterator<Item = &mut [f32]> {
        // Without rows there are no numbers, and nothing to iterate over.
        self.numbers.chunks_exact_mut(self.rows.max(1))
    }

    /// The matrix for products.
    pub(super) fn as_mat_mut(&mut self) -> MatMut<'_, f32> {
        MatMut::from_column_major_slice_mut(self.numbers, self.rows, self.columns)
    }

    /// The matrix for products that read it.
    pub(super) fn as_mat(&self) -> MatRef<'_, f32> {
        MatRef::from_column_major_slice(self.numbers, self.rows, self.columns)
    }

    /// The sum of every row.
    pub(super) fn sum_into(&self, sum: &mut [f32]) {
        sum_columns(self.numbers.chunks_exact(self.rows.max(1)), sum);
    }
}

/// Sums the columns.
pub(super) fn sum_columns<'a>(columns: impl Iterator<Item = &'a [f32]>, sum: &mut [f32]) {
    sum.fill(0.0);
    pulp::Arch::new().dispatch(|| {
        for column in columns {
            for (sum, number) in sum.iter_mut().zip(column) {
                *sum += *number;
            }
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_a_matrix_are_slices_of_its_columns() {
        let numbers = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
        let lower = Columns::new(&numbers, 3).rows(1, 2);
        assert_eq!(lower.iter().collect::<Vec<_>>(), [[2.0, 3.0], [5.0, 6.0]]);
        assert_eq!(lower.as_mat()[(1, 1)], 6.0);
        assert_eq!(
            Columns::new(&numbers, 3)
                .rows(3, 0)
                .iter()
                .map(<[f32]>::len)
                .sum::<usize>(),
            0
        );
    }

    #[test]
    fn a_matrix_may_have_no_rows() {
        let mut numbers = [1.0, 2.0, 3.0, 4.0];
        let (mut all, rest) = ColumnsMut::take(&mut numbers, 2, 2);
        assert_eq!(all.iter_mut().count(), 2);
        let mut sum = [f32::NAN; 2];
        all.sum_into(&mut sum);
        assert_eq!(sum, [4.0, 6.0]);
        let (mut none, _) = ColumnsMut::take(rest, 0, 2);
        assert_eq!((none.iter_mut().count(), none.as_mat_mut().ncols()), (0, 2));
    }
}
