//! The forward pass: one product a layer, then bias and activation in one sweep.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use pulp::{Arch, Simd, WithSimd};

use super::NetworkLayout;

/// A layer's weights (outputs × inputs, column-major) and biases, borrowed from the parameter slice.
#[derive(Clone, Copy, Debug)]
pub struct Layer<'a> {
    /// The weights W.
    pub weights: &'a [f32],
    /// The biases b.
    pub biases: &'a [f32],
}

/// Where a forward pass leaves what each layer reads or gives, one column a sample.
#[derive(Debug)]
pub struct Activations<'a> {
    /// First hidden layer, after ReLU; below it the late inputs.
    pub h1: &'a mut [f32],
    /// Second hidden layer, after ReLU.
    pub h2: &'a mut [f32],
    /// Output layer: linear.
    pub output: &'a mut [f32],
}

/// A column-major slice as a matrix with so many rows. Panics when the slice is not whole columns.
pub fn matrix(slice: &[f32], rows: usize) -> MatRef<'_, f32> {
    MatRef::from_column_major_slice(slice, rows, slice.len() / rows)
}

/// As [`matrix`], to be written.
pub fn matrix_mut(slice: &mut [f32], rows: usize) -> MatMut<'_, f32> {
    let columns = slice.len() / rows;
    MatMut::from_column_major_slice_mut(slice, rows, columns)
}

impl NetworkLayout {
    /// Computes the network's output for a batch of `inputs` and `late_inputs` (empty where the layout has none).
    ///
    /// The batch is as wide as the output has columns; every slice must fit it. The same numbers give the same bits
    /// wherever the slices lie in memory. Nothing is allocated.
    pub fn forward(&self, parameters: &[f32], inputs: &[f32], late_inputs: &[f32], to: Activations<'_>) {
        let [first, second, third] = self.layers(parameters);
        let [(inputs_1, h1), (inputs_2, h2), (_, outputs)] = self.layer_sizes();

        let one = inputs.len() == inputs_1;
        if one {
            one_sample(&mut to.h1[..h1], first.weights, inputs);
        } else {
            let z1 = matrix_mut(to.h1, inputs_2).subrows_mut(0, h1);
            product(z1, matrix(first.weights, h1), matrix(inputs, inputs_1));
        }
        add_bias_and_rectify(to.h1, inputs_2, first.biases);
        if self.late_inputs() > 0 {
            let columns = to.h1.chunks_exact_mut(inputs_2);
            for (column, late) in columns.zip(late_inputs.chunks_exact(self.late_inputs())) {
                column[h1..].copy_from_slice(late);
            }
        }

        if one {
            one_sample(to.h2, second.weights, to.h1);
        } else {
            let h1 = matrix(to.h1, inputs_2);
            product(matrix_mut(to.h2, h2), matrix(second.weights, h2), h1);
        }
        add_bias_and_rectify(to.h2, h2, second.biases);

        product(
            matrix_mut(to.output, outputs),
            matrix(third.weights, outputs),
            matrix(to.h2, h2),
        );
        for column in to.output.chunks_exact_mut(self.outputs()) {
            for (z, b) in column.iter_mut().zip(third.biases) {
                *z += b;
            }
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

    /// Reading W takes all the time there is. So columns that a rectified unit of 0 multiplies are left out (also where they
    /// hold what is not a number: the learner, whose batches are larger, sees that), and four others go by before z is stored.
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

/// z ← max(z + b, 0) for the first elements of every column of `rows` numbers, as many as there are biases. What is
/// not a number stays so, for the loss to show it.
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

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(count: usize, salt: usize) -> Vec<f32> {
        (0..count)
            .map(|i| ((i * 7919 + salt * 104_729) % 2003) as f32 / 1001.5 - 1.0)
            .collect()
    }

    fn run(layout: &NetworkLayout, parameters: &[f32], inputs: &[f32], late: &[f32]) -> Vec<f32> {
        let batch = inputs.len() / layout.inputs();
        let [h1, h2] = [layout.layer_sizes()[1].0, layout.hidden()[1]].map(|rows| rows * batch);
        let (mut h1, mut h2, mut output) = (vec![0.0; h1], vec![0.0; h2], vec![0.0; layout.outputs() * batch]);
        layout.forward(
            parameters,
            inputs,
            late,
            Activations {
                h1: &mut h1,
                h2: &mut h2,
                output: &mut output,
            },
        );
        output
    }

    /// One sample, by the definition, in `f64`.
    fn by_definition(layout: &NetworkLayout, parameters: &[f32], input: &[f32], late: &[f32]) -> Vec<f64> {
        let mut x: Vec<f64> = input.iter().map(|&x| x.into()).collect();
        for (number, layer) in layout.layers(parameters).into_iter().enumerate() {
            if number == 1 {
                x.extend(late.iter().map(|&a| f64::from(a)));
            }
            let outputs = layer.biases.len();
            x = (0..outputs)
                .map(|i| {
                    let sum: f64 = (0..x.len())
                        .map(|j| f64::from(layer.weights[j * outputs + i]) * x[j])
                        .sum();
                    let z = sum + f64::from(layer.biases[i]);
                    if number < 2 { z.max(0.0) } else { z }
                })
                .collect();
        }
        x
    }

    #[test]
    fn a_batch_is_what_the_definition_says_of_each_sample() {
        for (layout, batch) in [
            (NetworkLayout::policy(3, [40, 30], 2), 1),
            (NetworkLayout::policy(6, [40, 30], 1), 7),
            (NetworkLayout::critic(3, [40, 30], 1), 64),
            (NetworkLayout::critic(6, [41, 29], 2), 5),
        ] {
            let parameters = numbers(layout.parameters(), 1);
            let inputs = numbers(layout.inputs() * batch, 2);
            let late = numbers(layout.late_inputs() * batch, 3);
            let output = run(&layout, &parameters, &inputs, &late);
            for (sample, column) in output.chunks_exact(layout.outputs()).enumerate() {
                let input = &inputs[sample * layout.inputs()..][..layout.inputs()];
                let late = &late[sample * layout.late_inputs()..][..layout.late_inputs()];
                for (found, expected) in column.iter().zip(by_definition(&layout, &parameters, input, late)) {
                    assert!((f64::from(*found) - expected).abs() < 1e-4, "{found} for {expected}");
                }
            }
        }
    }

    #[test]
    fn where_the_parameters_lie_does_not_change_a_bit() {
        for batch in [1, 2, 8, 64] {
            let layout = NetworkLayout::critic(3, [400, 300], 1);
            let parameters = numbers(layout.parameters(), 1);
            let (inputs, late) = (numbers(3 * batch, 2), numbers(batch, 3));
            let expected = run(&layout, &parameters, &inputs, &late);
            for shift in [1, 3, 8, 13] {
                let mut moved = vec![0.0; shift];
                moved.extend(&parameters);
                assert_eq!(
                    run(&layout, &moved[shift..], &inputs, &late),
                    expected,
                    "batch {batch}, shift {shift}"
                );
            }
        }
    }

    #[test]
    fn what_is_not_a_number_is_not_rectified_away() {
        let layout = NetworkLayout::policy(1, [2, 2], 1);
        let mut parameters = vec![1.0; layout.parameters()];
        parameters[0] = f32::NAN;
        assert!(run(&layout, &parameters, &[1.0], &[])[0].is_nan());
    }
}
