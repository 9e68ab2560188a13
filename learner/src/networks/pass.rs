//! One network over one batch: forward, keeping the activations, and by hand backward through them.

use faer::{MatMut, MatRef};
use nalgebra::DMatrix;
use pulp::{Arch, Simd, WithSimd};
use shoal_common::network::{Activations, NetworkLayout, matrix, matrix_mut};

use super::columns::{Columns, ColumnsMut, sum_columns};
use super::product::{input_gradient, weight_gradient};
use super::threads::Threads;

/// The activations of a forward pass and room for their gradients; one column a sample.
#[derive(Clone, Debug)]
pub struct Pass {
    layout: NetworkLayout,
    h1: DMatrix<f32>,
    h2: DMatrix<f32>,
    /// The output layer's values, linear.
    pub output: DMatrix<f32>,
    d1: DMatrix<f32>,
    d2: DMatrix<f32>,
}

impl Pass {
    /// Room for `batch` samples.
    pub fn new(layout: NetworkLayout, batch: usize) -> Self {
        let zeros = |rows| DMatrix::zeros(rows, batch);
        let [(_, h1), (inputs_2, h2), (_, outputs)] = layout.layer_sizes();
        Self {
            layout,
            h1: zeros(inputs_2),
            h2: zeros(h2),
            output: zeros(outputs),
            d1: zeros(h1),
            d2: zeros(h2),
        }
    }

    /// Computes `output` for inputs `x` and late inputs `late` (empty where the network has none).
    pub fn forward(&mut self, parameters: &[f32], x: &[f32], late: &[f32]) {
        self.samples().forward(parameters, x, late);
    }

    /// Writes ∂L/∂θ, laid out as the parameters θ, into `gradient`, given `d` = ∂L/∂output of the forward pass that
    /// went before, with the same parameters and inputs.
    pub fn backward(
        &mut self,
        threads: &Threads,
        parameters: &[f32],
        x: &[f32],
        d: &DMatrix<f32>,
        gradient: &mut [f32],
    ) {
        self.samples().backward_to_second_layer(parameters, d.as_slice());
        self.gradients(threads, parameters, x, d, gradient);
    }

    /// All samples.
    pub fn samples(&mut self) -> Samples<'_> {
        Samples {
            layout: &self.layout,
            h1: self.h1.as_mut_slice(),
            h2: self.h2.as_mut_slice(),
            output: self.output.as_mut_slice(),
            d2: self.d2.as_mut_slice(),
        }
    }

    /// What is left of [`backward`](Self::backward) once [`Samples::backward_to_second_layer`] was called for all samples.
    /// Each thread has its share of the first hidden layer's units: the weights they are multiplied by, and the
    /// gradient that is passed down to them.
    pub fn gradients(
        &mut self,
        threads: &Threads,
        parameters: &[f32],
        x: &[f32],
        d: &DMatrix<f32>,
        gradient: &mut [f32],
    ) {
        let [_, second, _] = self.layout.layers(parameters);
        let [(inputs, h1), (inputs_2, h2), (_, outputs)] = self.layout.layer_sizes();
        let [g1, g2, g3] = self.layout.layer_ranges();
        let (gradient_1, rest) = gradient.split_at_mut(g1.biases.end);
        let (gradient_2, gradient_3) = rest.split_at_mut(g2.biases.end - g1.biases.end);
        let (w1, b1) = gradient_1.split_at_mut(g1.weights.len());
        let (w2, b2) = gradient_2.split_at_mut(g2.weights.len());
        let (w3, b3) = gradient_3.split_at_mut(g3.weights.len());

        let batch = self.d2.ncols();
        let (d2, d3) = (
            Columns::new(self.d2.as_slice(), h2),
            Columns::new(d.as_slice(), outputs),
        );
        weight_gradient(d3.as_mat(), matrix(self.h2.as_slice(), h2), matrix_mut(w3, outputs));
        sum_columns(d3.iter(), b3);
        sum_columns(d2.iter(), b2);

        let cut = threads.first_share(h1);
        let part =
            |w2: MatRef<'_, f32>, h1: Columns<'_>, mut d1: ColumnsMut<'_>, to: [MatMut<'_, f32>; 2], b1: &mut [f32]| {
                let [to_w1, to_w2] = to;
                weight_gradient(d2.as_mat(), h1.as_mat(), to_w2);
                input_gradient(w2, d2.as_mat(), d1.as_mat_mut());
                mask(d1.iter_mut(), h1.iter());
                d1.sum_into(b1);
                weight_gradient(d1.as_mat(), matrix(x, inputs), to_w1);
            };
        // The late inputs, which come last, are the second thread's, or the only one's.
        let weights = matrix(&second.weights[..h1 * h2], h2).split_at_col(cut);
        let units = Columns::new(self.h1.as_slice(), inputs_2);
        let units = (units.rows(0, cut), units.rows(cut, inputs_2 - cut));
        // A matrix for each thread, not rows of the same one: each has its columns in one piece.
        let (first_d1, rest) = ColumnsMut::take(self.d1.as_mut_slice(), cut, batch);
        let d1 = (first_d1, ColumnsMut::take(rest, h1 - cut, batch).0);
        let w1 = matrix_mut(w1, h1).split_at_row_mut(cut);
        let w2 = matrix_mut(w2, h2).split_at_col_mut(cut);
        let b1 = b1.split_at_mut(cut);
        threads.both(
            || part(weights.0, units.0, d1.0, [w1.0, w2.0], b1.0),
            || part(weights.1, units.1, d1.1, [w1.1, w2.1], b1.1),
        );
    }
}

/// Some samples of a [`Pass`], neighbours of each other.
#[derive(Debug)]
pub struct Samples<'a> {
    layout: &'a NetworkLayout,
    h1: &'a mut [f32],
    h2: &'a mut [f32],
    /// The output layer's values, linear.
    pub output: &'a mut [f32],
    d2: &'a mut [f32],
}

impl<'a> Samples<'a> {
    /// The first so many, and the others.
    pub fn split_at(self, samples: usize) -> (Self, Self) {
        let [_, (inputs_2, h2), (_, outputs)] = self.layout.layer_sizes();
        let h1 = self.h1.split_at_mut(samples * inputs_2);
        let [h2, d2] = [self.h2, self.d2].map(|numbers| numbers.split_at_mut(samples * h2));
        let output = self.output.split_at_mut(samples * outputs);
        let part = |h1: &'a mut [f32], h2, output, d2| Self {
            layout: self.layout,
            h1,
            h2,
            output,
            d2,
        };
        (part(h1.0, h2.0, output.0, d2.0), part(h1.1, h2.1, output.1, d2.1))
    }

    /// As [`Pass::forward`], of these samples.
    pub fn forward(&mut self, parameters: &[f32], x: &[f32], late: &[f32]) {
        let to = Activations {
            h1: self.h1,
            h2: self.h2,
            output: self.output,
        };
        self.layout.forward(parameters, x, late, to);
    }

    /// Computes ∂L/∂z of the second hidden layer, given `d` = ∂L/∂output of the forward pass that went before.
    pub fn backward_to_second_layer(&mut self, parameters: &[f32], d: &[f32]) {
        let [_, _, third] = self.layout.layers(parameters);
        let [_, (_, h2), (_, outputs)] = self.layout.layer_sizes();
        input_gradient(
            matrix(third.weights, outputs),
            matrix(d, outputs),
            matrix_mut(self.d2, h2),
        );
        mask(self.d2.chunks_exact_mut(h2), self.h2.chunks_exact(h2));
    }

    /// Writes ∂L/∂late into `to`, once that of the second hidden layer is there. Nothing below that is looked at: late
    /// inputs reach no further down.
    pub fn backward_to_late_inputs(&self, parameters: &[f32], to: &mut [f32]) {
        let [_, second, _] = self.layout.layers(parameters);
        let [h1, h2] = self.layout.hidden();
        let late = matrix(&second.weights[h1 * h2..], h2);
        input_gradient(late, matrix(self.d2, h2), matrix_mut(to, self.layout.late_inputs()));
    }
}

/// d ← d where the unit was active, else 0, column by column: from ∂L/∂h to ∂L/∂z through h = max(z, 0). A column of `h`
/// may be longer than that of `d`.
fn mask<'a>(d: impl Iterator<Item = &'a mut [f32]>, h: impl Iterator<Item = &'a [f32]>) {
    Arch::new().dispatch(Mask { d, h });
}

/// A closure of this length would be called by the dispatch, not inlined into it, and so go without vector instructions.
struct Mask<D, H> {
    d: D,
    h: H,
}

impl<'a, D: Iterator<Item = &'a mut [f32]>, H: Iterator<Item = &'a [f32]>> WithSimd for Mask<D, H> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (d, h) in self.d.zip(self.h) {
            for (d, h) in d.iter_mut().zip(h) {
                *d = if *h > 0.0 { *d } else { 0.0 };
            }
        }
    }
}
