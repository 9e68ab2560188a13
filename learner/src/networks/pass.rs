//! One network over one batch: the forward pass, which keeps the activations, and a hand-written backward pass.

use faer::{MatMut, MatRef};
use nalgebra::DMatrix;
use pulp::{Arch, Simd, WithSimd};
use shoal_common::network::{Activation, Activations, Hidden, Layers, NetworkLayout, matrix, matrix_mut};

use super::columns::{Columns, ColumnsMut, sum_columns};
use super::product::{input_gradient, weight_gradient};
use super::threads::Threads;

/// The activations of a forward pass and buffers for their gradients; one column per sample.
///
/// Layers are counted from 0: the hidden ones, and then the output layer.
#[derive(Clone, Debug)]
pub struct Pass {
    layout: NetworkLayout,
    /// The inputs with the action inputs below them, if these enter at the first layer; otherwise it has no rows.
    joined: DMatrix<f32>,
    /// Each hidden layer's activations, with the action inputs below them if these enter at the next layer.
    h: Vec<DMatrix<f32>>,
    /// The output layer's values, linear.
    pub output: DMatrix<f32>,
    /// ∂L/∂z of each hidden layer.
    dz: Vec<DMatrix<f32>>,
}

impl Pass {
    /// Buffers for `batch` samples.
    pub fn new(layout: NetworkLayout, batch: usize) -> Self {
        let zeros = |rows| DMatrix::zeros(rows, batch);
        Self {
            joined: zeros(rows_of_joined(&layout)),
            h: (layout.layer_sizes().skip(1))
                .map(|(inputs, _)| zeros(inputs))
                .collect(),
            output: zeros(layout.outputs()),
            dz: layout.hidden().layers.iter().map(|units| zeros(*units)).collect(),
            layout,
        }
    }

    /// Computes `output` for inputs `x` and `actions` (empty if the network has none).
    pub fn forward(&mut self, parameters: &[f32], x: &[f32], actions: &[f32]) {
        self.samples().forward(parameters, x, actions);
    }

    /// Writes ∂L/∂θ, laid out as the parameters θ, into `gradient`, given `d` = ∂L/∂output. A forward pass with the
    /// same parameters and inputs must come before.
    pub fn backward(
        &mut self,
        threads: &Threads,
        parameters: &[f32],
        x: &[f32],
        d: &DMatrix<f32>,
        gradient: &mut [f32],
    ) {
        // With three or more hidden layers, products below the last layer are large enough to share.
        if self.dz.len() > 2 {
            let cut = threads.first_share(d.ncols());
            let d = d.as_slice().split_at(cut * d.nrows());
            let (mut first, mut second) = self.samples().split_at(cut);
            threads.both(
                || first.backward(parameters, d.0, 1),
                || second.backward(parameters, d.1, 1),
            );
        } else {
            self.samples().backward(parameters, d.as_slice(), 1);
        }
        self.gradients(threads, parameters, x, d, gradient);
    }

    /// All samples.
    pub fn samples(&mut self) -> Samples<'_> {
        Samples {
            layout: &self.layout,
            joined: self.joined.as_mut_slice(),
            h: each_layer(&mut self.h),
            output: self.output.as_mut_slice(),
            dz: each_layer(&mut self.dz),
        }
    }

    /// Computes ∂L/∂θ. [`forward`](Self::forward) and, for all samples, [`Samples::backward`] down to layer 1 must come
    /// before. Each thread takes a part of the first layer's units with the second layer's inputs, and of the inputs of
    /// the layers between the second and the last.
    pub fn gradients(
        &mut self,
        threads: &Threads,
        parameters: &[f32],
        x: &[f32],
        d: &DMatrix<f32>,
        gradient: &mut [f32],
    ) {
        let lowest = self.upper_gradients(threads, d, gradient);
        self.lowest_gradients(threads, parameters, x, d, lowest);
    }

    /// The gradients of the third layer and of the layers above it. Returns the part of `gradient` for the two lowest
    /// layers.
    fn upper_gradients<'a>(&self, threads: &Threads, d: &DMatrix<f32>, gradient: &'a mut [f32]) -> &'a mut [f32] {
        let last = self.h.len();
        let mut rest = gradient;
        for layer in (2..=last).rev() {
            // The output layer's ∂L/∂z is `d` itself.
            let d = self.dz.get(layer).unwrap_or(d);
            let (inputs, outputs) = self.layout.layer_size(layer);
            let range = self.layout.layer_range(layer);
            let (below, own) = rest.split_at_mut(range.weights.start);
            rest = below;
            let (w, b) = own.split_at_mut(range.weights.len());
            let d = Columns::new(d.as_slice(), outputs);
            let h = Columns::new(self.h[layer - 1].as_slice(), inputs);
            if layer == last {
                weight_gradient(d.as_mat(), h.as_mat(), matrix_mut(w, outputs));
            } else {
                let cut = threads.first_share(inputs);
                let h = (h.rows(0, cut), h.rows(cut, inputs - cut));
                let w = matrix_mut(w, outputs).split_at_col_mut(cut);
                threads.both(
                    || weight_gradient(d.as_mat(), h.0.as_mat(), w.0),
                    || weight_gradient(d.as_mat(), h.1.as_mat(), w.1),
                );
            }
            sum_columns(d.iter(), b);
        }
        rest
    }

    /// The gradients of the two lowest layers.
    fn lowest_gradients(
        &mut self,
        threads: &Threads,
        parameters: &[f32],
        x: &[f32],
        d: &DMatrix<f32>,
        gradient: &mut [f32],
    ) {
        let Self {
            layout, joined, h, dz, ..
        } = self;
        let activation = layout.hidden().activation;
        let batch = d.ncols();
        // ∂L/∂z of the first layer, which is computed below, and of the layers above it.
        let (d1, dz) = dz.split_at_mut(1);
        let [(inputs, h1), (inputs_2, h2)] = [0, 1].map(|layer| layout.layer_size(layer));
        let second = layout.layer(1, parameters);
        let [g1, g2] = [0, 1].map(|layer| layout.layer_range(layer));
        let (gradient_1, gradient_2) = gradient.split_at_mut(g1.biases.end);
        let (w1, b1) = gradient_1.split_at_mut(g1.weights.len());
        let (w2, b2) = gradient_2.split_at_mut(g2.weights.len());
        let x = if layout.action_layer() == Some(0) {
            joined.as_slice()
        } else {
            x
        };
        // With one hidden layer, the second layer is the output layer.
        let d2 = Columns::new(dz.first().unwrap_or(d).as_slice(), h2);
        sum_columns(d2.iter(), b2);

        let cut = threads.first_share(h1);
        let part =
            |w2: MatRef<'_, f32>, h1: Columns<'_>, mut d1: ColumnsMut<'_>, to: [MatMut<'_, f32>; 2], b1: &mut [f32]| {
                let [to_w1, to_w2] = to;
                weight_gradient(d2.as_mat(), h1.as_mat(), to_w2);
                input_gradient(w2, d2.as_mat(), d1.as_mat_mut());
                apply_slope(activation, d1.iter_mut(), h1.iter());
                d1.sum_into(b1);
                weight_gradient(d1.as_mat(), matrix(x, inputs), to_w1);
            };
        // The action inputs come last, so they belong to the second thread, or to the only one.
        let weights = matrix(&second.weights[..h1 * h2], h2).split_at_col(cut);
        let units = Columns::new(h[0].as_slice(), inputs_2);
        let units = (units.rows(0, cut), units.rows(cut, inputs_2 - cut));
        // A matrix for each thread, not rows of the same one, so that columns are contiguous.
        let (first_d1, rest) = ColumnsMut::take(d1[0].as_mut_slice(), cut, batch);
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

/// Rows of `Pass::joined`: 0 if action inputs do not enter at the first layer.
fn rows_of_joined(layout: &NetworkLayout) -> usize {
    match layout.action_layer() {
        Some(0) => layout.layer_size(0).0,
        _ => 0,
    }
}

/// A matrix for each hidden layer. The rest are empty.
type EachLayer<'a> = [&'a mut [f32]; Layers::MAX];

fn each_layer(matrices: &mut [DMatrix<f32>]) -> EachLayer<'_> {
    let mut each = EachLayer::default();
    for (slice, matrix) in each.iter_mut().zip(matrices) {
        *slice = matrix.as_mut_slice();
    }
    each
}

/// Splits each matrix after `columns` columns. `rows` has the rows of each.
fn split_each<'a>(
    matrices: EachLayer<'a>,
    columns: usize,
    rows: impl Iterator<Item = usize>,
) -> (EachLayer<'a>, EachLayer<'a>) {
    let mut parts = (EachLayer::default(), EachLayer::default());
    let halves = parts.0.iter_mut().zip(&mut parts.1);
    for ((first, second), (matrix, rows)) in halves.zip(matrices.into_iter().zip(rows)) {
        (*first, *second) = matrix.split_at_mut(columns * rows);
    }
    parts
}

/// A range of samples of a [`Pass`].
#[derive(Debug)]
pub struct Samples<'a> {
    layout: &'a NetworkLayout,
    joined: &'a mut [f32],
    h: EachLayer<'a>,
    /// The output layer's values, linear.
    pub output: &'a mut [f32],
    dz: EachLayer<'a>,
}

impl<'a> Samples<'a> {
    /// The first `samples` samples, and the others.
    pub fn split_at(self, samples: usize) -> (Self, Self) {
        let layout = self.layout;
        let joined = self.joined.split_at_mut(samples * rows_of_joined(layout));
        let h = split_each(self.h, samples, layout.layer_sizes().skip(1).map(|(inputs, _)| inputs));
        let output = self.output.split_at_mut(samples * layout.outputs());
        let dz = split_each(self.dz, samples, layout.hidden().layers.iter().copied());
        let part = |joined, h, output, dz| Self {
            layout,
            joined,
            h,
            output,
            dz,
        };
        (part(joined.0, h.0, output.0, dz.0), part(joined.1, h.1, output.1, dz.1))
    }

    /// As [`Pass::forward`], for these samples.
    pub fn forward(&mut self, parameters: &[f32], x: &[f32], actions: &[f32]) {
        let to = Activations {
            joined: self.joined,
            hidden: self.h.iter_mut().map(|h| &mut **h),
            output: self.output,
        };
        self.layout.forward(parameters, x, actions, to);
    }

    /// Computes ∂L/∂z of the hidden layers, from the last one down to `lowest`, given `d` = ∂L/∂output of the forward
    /// pass before. Does nothing if `lowest` is the output layer.
    pub fn backward(&mut self, parameters: &[f32], d: &[f32], lowest: usize) {
        let layout = self.layout;
        let Hidden { layers, activation } = layout.hidden();
        let mut d_above = d;
        let hidden = self.dz.iter_mut().zip(&self.h).zip(layers.iter()).enumerate();
        for (layer, ((d, h), units)) in hidden.skip(lowest).rev() {
            let (inputs, outputs) = layout.layer_size(layer + 1);
            let w = &layout.layer(layer + 1, parameters).weights[..units * outputs];
            input_gradient(matrix(w, outputs), matrix(d_above, outputs), matrix_mut(d, *units));
            apply_slope(activation, d.chunks_exact_mut(*units), h.chunks_exact(inputs));
            d_above = &**d;
        }
    }

    /// Writes ∂L/∂action into `to`, given `d` = ∂L/∂output. It does not go below the layer where the action inputs
    /// enter, and does nothing if there are none.
    pub fn backward_to_actions(&mut self, parameters: &[f32], d: &[f32], to: &mut [f32]) {
        let layout = self.layout;
        let Some(layer) = layout.action_layer() else {
            return;
        };
        self.backward(parameters, d, layer);
        let (inputs, units) = layout.layer_size(layer);
        let own_inputs = inputs - layout.action_inputs();
        let weights = &layout.layer(layer, parameters).weights[own_inputs * units..];
        input_gradient(
            matrix(weights, units),
            matrix(self.dz[layer], units),
            matrix_mut(to, layout.action_inputs()),
        );
    }
}

/// Turns ∂L/∂h into ∂L/∂z, column by column, by the activation's slope, which follows from h. A column of `h` may be
/// longer than a column of `d`.
fn apply_slope<'a>(activation: Activation, d: impl Iterator<Item = &'a mut [f32]>, h: impl Iterator<Item = &'a [f32]>) {
    match activation {
        Activation::Relu => Arch::new().dispatch(Slope {
            d,
            h,
            of: |d, h| if h > 0.0 { d } else { 0.0 },
        }),
        Activation::Tanh => Arch::new().dispatch(Slope {
            d,
            h,
            of: |d, h| d * (1.0 - h * h),
        }),
    }
}

/// Not a closure, because the dispatch would not inline such a long one, and it would have no vector instructions.
struct Slope<D, H, F> {
    d: D,
    h: H,
    /// ∂L/∂z of ∂L/∂h and h.
    of: F,
}

impl<'a, D, H, F> WithSimd for Slope<D, H, F>
where
    D: Iterator<Item = &'a mut [f32]>,
    H: Iterator<Item = &'a [f32]>,
    F: Fn(f32, f32) -> f32,
{
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        for (d, h) in self.d.zip(self.h) {
            for (d, h) in d.iter_mut().zip(h) {
                *d = (self.of)(*d, *h);
            }
        }
    }
}
