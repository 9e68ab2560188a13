//! The limit that the learner is compared with: single-precision matrix products of the shapes in a gradient step, with
//! the faster of two kernels.
//!
//! Both kernels read transposed factors through strides, as a gradient step does; nothing is transposed beforehand. The
//! factors are warm in the caches, because each product is repeated on the same numbers.

use std::time::Duration;

use faer::linalg::matmul::matmul;
use faer::{Accum, Par};
use nalgebra::{DMatrixView, DMatrixViewMut, Dyn};
use rand::RngExt;
use shoal_common::network::{matrix, matrix_mut};
use shoal_common::stream::Stream;
use shoal_learner::networks::aligned::Aligned;
use shoal_learner::networks::product::{Product, Transposed};

use super::intervals;

/// Length of an attempt. It is shorter than a time slice, so that most attempts are undisturbed.
const ATTEMPT_LENGTH: Duration = Duration::from_millis(2);

/// With a dimension of at most this, nalgebra 0.35 does not use matrixmultiply but `axcpy`. For a vector with a stride,
/// that takes the length of its storage for the vector's, and writes beyond the result.
const TINY: usize = 5;

/// An implementation of matrix products.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kernel {
    /// faer's `matmul`.
    Faer,
    /// nalgebra's `gemm`, which is `matrixmultiply::sgemm`. Not for a [tiny](TINY) dimension.
    Nalgebra,
}

impl Kernel {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Faer => "faer",
            Self::Nalgebra => "nalgebra (matrixmultiply)",
        }
    }
}

/// A product with its matrices, and its fastest kernel.
#[derive(Debug)]
pub(super) struct TimedProduct {
    pub(super) product: Product,
    pub(super) kernel: Kernel,
    /// The best rate seen, in GFLOP/s.
    pub(super) best: f64,
    a: Aligned,
    b: Aligned,
    c: Aligned,
}

impl TimedProduct {
    /// Random factors; the kernel is faer until others are tried.
    pub(super) fn new(product: Product, random: &mut Stream) -> Self {
        let Product { m, k, n, .. } = product;
        let mut numbers =
            |count: usize| -> Vec<f32> { (0..count).map(|_| 2.0 * random.random::<f32>() - 1.0).collect() };
        Self {
            product,
            kernel: Kernel::Faer,
            best: 0.0,
            a: Aligned::from_slice(&numbers(m * k), 0),
            b: Aligned::from_slice(&numbers(k * n), 1),
            c: Aligned::zeros(m * n, 2),
        }
    }

    /// The kernels that can compute it.
    fn kernels(&self) -> &'static [Kernel] {
        let Product { m, k, n, .. } = self.product;
        if m.min(k).min(n) > TINY {
            &[Kernel::Faer, Kernel::Nalgebra]
        } else {
            &[Kernel::Faer]
        }
    }

    /// Tries every kernel briefly and keeps the fastest so far.
    pub(super) fn try_kernels(&mut self) {
        let mut chosen = self.kernel;
        for &kernel in self.kernels() {
            self.kernel = kernel;
            let rate = self.gflops(ATTEMPT_LENGTH);
            if rate > self.best {
                (self.best, chosen) = (rate, kernel);
            }
        }
        self.kernel = chosen;
    }

    /// The rate over `length`, in GFLOP/s.
    pub(super) fn gflops(&mut self, length: Duration) -> f64 {
        intervals::rate(length, || self.multiply()) * self.product.flop() as f64 / 1e9
    }

    pub(super) fn multiply(&mut self) {
        let Product { m, k, n, transposed } = self.product;
        match self.kernel {
            Kernel::Faer => {
                let a = match transposed {
                    Transposed::Left => matrix(&self.a, k).transpose(),
                    _ => matrix(&self.a, m),
                };
                let b = match transposed {
                    Transposed::Right => matrix(&self.b, n).transpose(),
                    _ => matrix(&self.b, k),
                };
                matmul(matrix_mut(&mut self.c, m), Accum::Replace, a, b, 1.0, Par::Seq);
            }
            Kernel::Nalgebra => {
                let a = view(&self.a, m, k, transposed == Transposed::Left);
                let b = view(&self.b, k, n, transposed == Transposed::Right);
                DMatrixViewMut::from_slice(&mut self.c, m, n).gemm(1.0, &a, &b, 0.0);
            }
        }
        std::hint::black_box(&mut self.c);
    }

    /// Text for the user: the shape, and which factor is read transposed.
    pub(super) fn shape(&self) -> String {
        let Product { m, k, n, transposed } = self.product;
        let which = match transposed {
            Transposed::Neither => "",
            Transposed::Left => ", left transposed",
            Transposed::Right => ", right transposed",
        };
        format!("{m}x{k} by {k}x{n}{which}")
    }
}

/// A column-major matrix, or the transpose of one, as rows × columns.
fn view(numbers: &[f32], rows: usize, columns: usize, transposed: bool) -> DMatrixView<'_, f32, Dyn, Dyn> {
    let strides = if transposed { (columns, 1) } else { (1, rows) };
    DMatrixView::from_slice_with_strides(numbers, rows, columns, strides.0, strides.1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_common::stream::{Purpose, stream};

    /// The product by its definition, in `f64`, column by column.
    fn by_definition(multiplication: &TimedProduct) -> Vec<f64> {
        let Product { m, k, n, transposed } = multiplication.product;
        let a = |i: usize, j: usize| match transposed {
            Transposed::Left => multiplication.a[i * k + j],
            _ => multiplication.a[j * m + i],
        };
        let b = |i: usize, j: usize| match transposed {
            Transposed::Right => multiplication.b[i * n + j],
            _ => multiplication.b[j * k + i],
        };
        let term = |i, j, l| f64::from(a(i, l)) * f64::from(b(l, j));
        let element = |at: usize| (0..k).map(|l| term(at % m, at / m, l)).sum();
        (0..m * n).map(element).collect()
    }

    #[test]
    fn every_kernel_computes_the_product() {
        let mut random = stream(1, Purpose::Exploration, 0, 0);
        let mut kernels = 0;
        for transposed in [Transposed::Neither, Transposed::Left, Transposed::Right] {
            for (m, k, n) in [(12, 7, 9), (1, 8, 6), (10, 3, 4), (64, 2, 32)] {
                let mut multiplication = TimedProduct::new(Product { m, k, n, transposed }, &mut random);
                let expected = by_definition(&multiplication);
                for &kernel in multiplication.kernels() {
                    multiplication.kernel = kernel;
                    multiplication.c.fill(f32::NAN);
                    multiplication.multiply();
                    for (found, expected) in multiplication.c.iter().zip(&expected) {
                        let distance = (f64::from(*found) - expected).abs();
                        assert!(
                            distance < 1e-5,
                            "{kernel:?}, {transposed:?} {m} {k} {n}: {found} for {expected}"
                        );
                    }
                    kernels += 1;
                }
            }
        }
        assert_eq!(kernels, 15, "both for the first size");
    }
}
