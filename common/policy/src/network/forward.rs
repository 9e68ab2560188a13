//! The forward pass: for each layer one matrix product, then bias and activation in a single pass over the result.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use pulp::{Arch, Simd, WithSimd};

use super::{Activation, LayerRange, NetworkLayout};

/// A layer's weights (outputs × inputs, column-major) and biases, borrowed from the parameter slice.
#[derive(Clone, Copy, Debug)]
pub struct Layer<'a> {
    /// The weights W.
    pub weights: &'a [f32],
    /// The biases b.
    pub biases: &'a [f32],
}

impl<'a> Layer<'a> {
    pub(super) fn at(range: LayerRange, parameters: &'a [f32]) -> Self {
        Self {
            weights: &parameters[range.weights],
            biases: &parameters[range.biases],
        }
    }
}

/// The buffers of a forward pass, one column for each sample.
#[derive(Debug)]
pub struct Activations<'a, H> {
    /// The inputs, followed by the action inputs, if these enter at the first layer; otherwise empty.
    pub joined: &'a mut [f32],
    /// The outputs of each hidden layer, followed by the action inputs if these enter at the next layer.
    pub hidden: H,
    /// The linear outputs of the output layer.
    pub output: &'a mut [f32],
}

/// A column-major slice as a matrix with this many rows.
///
/// # Panics
/// If the slice does not consist of whole columns.
pub fn matrix(slice: &[f32], rows: usize) -> MatRef<'_, f32> {
    MatRef::from_column_major_slice(slice, rows, slice.len() / rows)
}

/// As [`matrix`], but mutable.
pub fn matrix_mut(slice: &mut [f32], rows: usize) -> MatMut<'_, f32> {
    let columns = slice.len() / rows;
    MatMut::from_column_major_slice_mut(slice, rows, columns)
}

impl NetworkLayout {
    /// Computes the network's output for a batch of `inputs` and of `actions` (empty if the layout has no action
    /// inputs).
    ///
    /// Every slice must have one column for each sample of the batch, and `to.hidden` must have a slice for each hidden
    /// layer. The same numbers give the same bits, whatever the alignment of the slices. Nothing is allocated.
    pub fn forward<'a>(
        &self,
        parameters: &[f32],
        inputs: &'a [f32],
        actions: &[f32],
        to: Activations<'a, impl Iterator<Item = &'a mut [f32]>>,
    ) {
        let action_layer = self.action_layer();
        let one = inputs.len() == self.inputs;
        let mut x = inputs;
        if action_layer == Some(0) {
            let rows = self.inputs + self.action_inputs;
            for (column, x) in to.joined.chunks_exact_mut(rows).zip(inputs.chunks_exact(self.inputs)) {
                column[..self.inputs].copy_from_slice(x);
            }
            self.join(to.joined, rows, actions);
            x = to.joined;
        }
        for (number, (units, h)) in self.hidden.layers.iter().zip(to.hidden).enumerate() {
            let layer = self.layer(number, parameters);
            let (rows_of_x, rows) = (self.layer_size(number).0, self.layer_size(number + 1).0);
            if one {
                one_sample(&mut h[..*units], layer.weights, x);
            } else {
                let z = matrix_mut(h, rows).subrows_mut(0, *units);
                product(z, matrix(layer.weights, *units), matrix(x, rows_of_x));
            }
            match self.hidden.activation {
                Activation::Relu => add_bias_and_rectify(h, rows, layer.biases),
                Activation::Tanh => add_bias_and_squash(h, rows, layer.biases),
            }
            if action_layer == Some(number + 1) {
                self.join(h, rows, actions);
            }
            x = h;
        }

        let last = self.hidden.layers.len();
        let (layer, (rows_of_x, outputs)) = (self.layer(last, parameters), self.layer_size(last));
        product(
            matrix_mut(to.output, outputs),
            matrix(layer.weights, outputs),
            matrix(x, rows_of_x),
        );
        for column in to.output.chunks_exact_mut(outputs) {
            for (z, b) in column.iter_mut().zip(layer.biases) {
                *z += b;
            }
        }
    }

    /// Writes the action inputs into the last of the `rows` numbers of every column of `x`.
    fn join(&self, x: &mut [f32], rows: usize, actions: &[f32]) {
        let width = self.action_inputs;
        for (column, action) in x.chunks_exact_mut(rows).zip(actions.chunks_exact(width)) {
            column[rows - width..].copy_from_slice(action);
        }
    }
}

/// z ← W x
fn product(z: MatMut<'_, f32>, w: MatRef<'_, f32>, x: MatRef<'_, f32>) {
    matmul(z, Accum::Replace, w, x, 1.0, Par::Seq);
}

/// z ← W x for one sample.
fn one_sample(z: &mut [f32], w: &[f32], x: &[f32]) {
    Arch::new().dispatch(OneSample { z, w, x });
}

struct OneSample<'a> {
    z: &'a mut [f32],
    w: &'a [f32],
    x: &'a [f32],
}

impl WithSimd for OneSample<'_> {
    type Output = ();

    /// Reading W takes most of the time. So columns whose factor is 0, as of an inactive ReLU unit, are skipped, and
    /// four others are read before z is stored. A NaN in a skipped column is missed here; the learner, which computes
    /// larger batches, detects it.
    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self { z, w, x } = self;
        z.fill(0.0);
        let mut columns = w.chunks_exact(z.len()).zip(x).filter(|(_, x)| **x != 0.0);
        while let Some((a, x_a)) = columns.next() {
            let mut next = || columns.next().unwrap_or((a, &0.0));
            let ((b, x_b), (c, x_c), (d, x_d)) = (next(), next(), next());
            for ((((z, a), b), c), d) in z.iter_mut().zip(a).zip(b).zip(c).zip(d) {
                *z += (a * x_a + b * x_b) + (c * x_c + d * x_d);
            }
        }
    }
}

/// z ← max(z + b, 0) for the first elements of every column of `rows` numbers, one for each bias. NaN stays NaN, so
/// that it shows in the loss.
fn add_bias_and_rectify(z: &mut [f32], rows: usize, biases: &[f32]) {
    Arch::new().dispatch(|| {
        for column in z.chunks_exact_mut(rows) {
            for (z, b) in column.iter_mut().zip(biases) {
                let sum = *z + b;
                *z = if sum < 0.0 { 0.0 } else { sum };
            }
        }
    });
}

/// z ← tanh(z + b), as [`add_bias_and_rectify`].
fn add_bias_and_squash(z: &mut [f32], rows: usize, biases: &[f32]) {
    for column in z.chunks_exact_mut(rows) {
        for (z, b) in column.iter_mut().zip(biases) {
            *z = (*z + b).tanh();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::Hidden;
    use super::*;

    fn numbers(count: usize, salt: usize) -> Vec<f32> {
        (0..count)
            .map(|i| ((i * 7919 + salt * 104_729) % 2003) as f32 / 1001.5 - 1.0)
            .collect()
    }

    fn run(layout: &NetworkLayout, parameters: &[f32], inputs: &[f32], actions: &[f32]) -> Vec<f32> {
        let batch = inputs.len() / layout.inputs();
        let joined = if layout.action_layer() == Some(0) {
            layout.layer_size(0).0
        } else {
            0
        };
        let rows = layout.layer_sizes().skip(1).map(|(rows, _)| rows);
        let mut hidden: Vec<Vec<f32>> = rows.map(|rows| vec![0.0; rows * batch]).collect();
        let mut output = vec![0.0; layout.outputs() * batch];
        let to = Activations {
            joined: &mut vec![0.0; joined * batch],
            hidden: hidden.iter_mut().map(Vec::as_mut_slice),
            output: &mut output,
        };
        layout.forward(parameters, inputs, actions, to);
        output
    }

    /// The output for one sample, computed in `f64` from the definition.
    fn by_definition(layout: &NetworkLayout, parameters: &[f32], input: &[f32], actions: &[f32]) -> Vec<f64> {
        let mut x: Vec<f64> = input.iter().map(|&x| x.into()).collect();
        for (number, layer) in layout.layers(parameters).enumerate() {
            if Some(number) == layout.action_layer() {
                x.extend(actions.iter().map(|&a| f64::from(a)));
            }
            let outputs = layer.biases.len();
            x = (0..outputs)
                .map(|i| {
                    let sum: f64 = (0..x.len())
                        .map(|j| f64::from(layer.weights[j * outputs + i]) * x[j])
                        .sum();
                    let z = sum + f64::from(layer.biases[i]);
                    match layout.hidden().activation {
                        _ if number == layout.hidden().layers.len() => z,
                        Activation::Relu => z.max(0.0),
                        Activation::Tanh => z.tanh(),
                    }
                })
                .collect();
        }
        x
    }

    #[test]
    fn a_batch_agrees_with_the_definition_for_each_sample() {
        for (layout, batch) in [
            (NetworkLayout::new(3, Hidden::relu([40, 30]), 2), 1),
            (NetworkLayout::new(6, Hidden::relu([40, 30]), 1), 7),
            (NetworkLayout::critic(3, Hidden::relu([40, 30]), 1), 64),
            (NetworkLayout::critic(6, Hidden::tanh([41, 29]), 2), 5),
            (NetworkLayout::critic(6, Hidden::relu([41]), 2), 1),
            (NetworkLayout::critic(6, Hidden::tanh([41]), 2), 5),
            (NetworkLayout::joined_critic(6, Hidden::relu([41, 29]), 2), 5),
            (NetworkLayout::joined_critic(3, Hidden::tanh([20, 41, 13]), 2), 1),
            (NetworkLayout::new(6, Hidden::tanh([41]), 2), 1),
            (NetworkLayout::new(3, Hidden::tanh([20, 41, 13]), 2), 1),
            (NetworkLayout::critic(3, Hidden::relu([20, 41, 13]), 2), 33),
            (NetworkLayout::critic(3, Hidden::tanh([9, 8, 7, 6, 5, 6, 7, 8]), 2), 1),
            (NetworkLayout::critic(3, Hidden::tanh([9, 8, 7, 6, 5, 6, 7, 8]), 2), 6),
        ] {
            let parameters = numbers(layout.parameters(), 1);
            let inputs = numbers(layout.inputs() * batch, 2);
            let actions = numbers(layout.action_inputs() * batch, 3);
            let output = run(&layout, &parameters, &inputs, &actions);
            for (sample, column) in output.chunks_exact(layout.outputs()).enumerate() {
                let input = &inputs[sample * layout.inputs()..][..layout.inputs()];
                let actions = &actions[sample * layout.action_inputs()..][..layout.action_inputs()];
                for (found, expected) in column.iter().zip(by_definition(&layout, &parameters, input, actions)) {
                    assert!(
                        (f64::from(*found) - expected).abs() < 1e-4,
                        "{found} instead of {expected}"
                    );
                }
            }
        }
    }

    #[test]
    fn the_alignment_of_the_parameters_does_not_change_the_bits() {
        for (batch, hidden) in [1, 2, 8, 64].into_iter().flat_map(|batch| {
            let lists = [
                Hidden::relu([400, 300]),
                Hidden::tanh([400]),
                Hidden::relu([64, 33, 64]),
            ];
            lists.map(|hidden| (batch, hidden))
        }) {
            let layout = NetworkLayout::critic(3, hidden, 1);
            let parameters = numbers(layout.parameters(), 1);
            let (inputs, actions) = (numbers(3 * batch, 2), numbers(batch, 3));
            let expected = run(&layout, &parameters, &inputs, &actions);
            for shift in [1, 3, 8, 13] {
                let mut moved = vec![0.0; shift];
                moved.extend(&parameters);
                assert_eq!(
                    run(&layout, &moved[shift..], &inputs, &actions),
                    expected,
                    "{hidden:?}, batch {batch}, shift {shift}"
                );
            }
        }
    }

    #[test]
    fn nan_passes_through_the_activations() {
        for hidden in [Hidden::relu([2, 2]), Hidden::tanh([2, 2, 2])] {
            let layout = NetworkLayout::new(1, hidden, 1);
            let mut parameters = vec![1.0; layout.parameters()];
            parameters[0] = f32::NAN;
            assert!(run(&layout, &parameters, &[1.0], &[])[0].is_nan());
        }
    }
}
