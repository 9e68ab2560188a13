//! One network over one batch: forward, keeping the activations, and by hand backward through them.

use crate::product::{input_gradient, weight_gradient};
use nalgebra::DMatrix;
use pulp::Arch;
use shoal_common::network::{Activations, NetworkLayout};

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
        let to = Activations {
            h1: self.h1.as_mut_slice(),
            h2: self.h2.as_mut_slice(),
            output: self.output.as_mut_slice(),
        };
        self.layout.forward(parameters, x, late, to);
    }

    /// Writes ∂L/∂θ, laid out as the parameters θ, into `gradient`, given `d` = ∂L/∂output of the forward pass that
    /// went before, with the same parameters and inputs.
    pub fn backward(&mut self, parameters: &[f32], x: &[f32], d: &DMatrix<f32>, gradient: &mut [f32]) {
        let [_, second, third] = self.layout.layers(parameters);
        let [g1, g2, g3] = self.layout.layer_ranges();
        let [h1, h2] = self.layout.hidden();

        weight_gradient(d, self.h2.as_slice(), &mut gradient[g3.weights]);
        sum_columns(d.as_slice(), &mut gradient[g3.biases]);

        input_gradient(third.weights, d, &mut self.d2);
        mask_and_sum_columns(&mut self.d2, &self.h2, &mut gradient[g2.biases]);
        weight_gradient(&self.d2, self.h1.as_slice(), &mut gradient[g2.weights]);

        input_gradient(&second.weights[..h1 * h2], &self.d2, &mut self.d1);
        mask_and_sum_columns(&mut self.d1, &self.h1, &mut gradient[g1.biases]);
        weight_gradient(&self.d1, x, &mut gradient[g1.weights]);
    }

    /// Writes ∂L/∂late into `to`, given `d` = ∂L/∂output of the forward pass that went before. Nothing below the second
    /// hidden layer is looked at: late inputs reach no further down.
    pub fn backward_to_late_inputs(&mut self, parameters: &[f32], d: &DMatrix<f32>, to: &mut DMatrix<f32>) {
        let [_, second, third] = self.layout.layers(parameters);
        let [h1, h2] = self.layout.hidden();
        input_gradient(third.weights, d, &mut self.d2);
        mask(&mut self.d2, &self.h2);
        input_gradient(&second.weights[h1 * h2..], &self.d2, to);
    }
}

/// d ← d where the unit was active, else 0: from ∂L/∂h to ∂L/∂z through h = max(z, 0). `sum` becomes the sum of d's
/// columns, ∂L/∂b. `h` may have more rows than `d`.
fn mask_and_sum_columns(d: &mut DMatrix<f32>, h: &DMatrix<f32>, sum: &mut [f32]) {
    let (units, rows) = (d.nrows(), h.nrows());
    let columns = d
        .as_mut_slice()
        .chunks_exact_mut(units)
        .zip(h.as_slice().chunks_exact(rows));
    sum.fill(0.0);
    Arch::new().dispatch(|| {
        for (d, h) in columns {
            for ((d, h), sum) in d.iter_mut().zip(h).zip(sum.iter_mut()) {
                *d = if *h > 0.0 { *d } else { 0.0 };
                *sum += *d;
            }
        }
    });
}

/// As [`mask_and_sum_columns`], without the sum.
fn mask(d: &mut DMatrix<f32>, h: &DMatrix<f32>) {
    Arch::new().dispatch(|| {
        for (d, h) in d.iter_mut().zip(h.iter()) {
            *d = if *h > 0.0 { *d } else { 0.0 };
        }
    });
}

fn sum_columns(d: &[f32], sum: &mut [f32]) {
    sum.fill(0.0);
    for column in d.chunks_exact(sum.len()) {
        for (sum, d) in sum.iter_mut().zip(column) {
            *sum += d;
        }
    }
}
