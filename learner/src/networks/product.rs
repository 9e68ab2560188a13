//! The matrix products of a gradient step: the products of the backward pass, and a list of all of them for the
//! benchmark.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};
use shoal_common::network::NetworkLayout;

/// ∂L/∂W = d xᵀ, summed over the batch: `d` is ∂L/∂z of the layer's outputs, `x` its inputs, one column per sample.
pub fn weight_gradient(d: MatRef<'_, f32>, x: MatRef<'_, f32>, gradient: MatMut<'_, f32>) {
    matmul(gradient, Accum::Replace, d, x.transpose(), 1.0, Par::Seq);
}

/// ∂L/∂x = Wᵀ d, column by column: the gradient that a layer with weights `w` passes down to its inputs.
pub fn input_gradient(w: MatRef<'_, f32>, d: MatRef<'_, f32>, to: MatMut<'_, f32>) {
    matmul(to, Accum::Replace, w.transpose(), d, 1.0, Par::Seq);
}

/// Which factor of a product is read transposed (all are stored column-major).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Transposed {
    /// W x, forward.
    Neither,
    /// Wᵀ d, a gradient passed down.
    Left,
    /// d xᵀ, a gradient of weights.
    Right,
}

/// The shape of one product: an m × k by a k × n matrix.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Product {
    /// Rows of the result.
    pub m: usize,
    /// The dimension that is summed over.
    pub k: usize,
    /// Columns of the result.
    pub n: usize,
    /// Which factor is read transposed.
    pub transposed: Transposed,
}

impl Product {
    fn new(m: usize, k: usize, n: usize, transposed: Transposed) -> Self {
        Self { m, k, n, transposed }
    }

    /// Floating-point operations: a multiplication and an addition for each term.
    pub fn flop(&self) -> u64 {
        2 * (self.m * self.k * self.n) as u64
    }
}

/// The products of a forward pass of `batch` samples.
pub fn forward(network: &NetworkLayout, batch: usize) -> impl Iterator<Item = Product> {
    network
        .layer_sizes()
        .map(move |(inputs, outputs)| Product::new(outputs, inputs, batch, Transposed::Neither))
}

/// The products of a backward pass for the gradient of all weights.
pub fn backward(network: &NetworkLayout, batch: usize) -> impl Iterator<Item = Product> {
    (0..=output_layer(network)).rev().flat_map(move |layer| {
        let (inputs, outputs) = network.layer_size(layer);
        let weights = Product::new(outputs, batch, inputs, Transposed::Right);
        [weights]
            .into_iter()
            .chain((layer > 0).then(|| down(network, layer, batch)))
    })
}

/// The products of a backward pass to the action inputs of a critic.
pub fn backward_to_actions(critic: &NetworkLayout, batch: usize) -> impl Iterator<Item = Product> {
    critic.action_layer().into_iter().flat_map(move |entry| {
        let above = (entry + 1..=output_layer(critic)).rev();
        let units = critic.layer_size(entry).1;
        let inputs = Product::new(critic.action_inputs(), units, batch, Transposed::Left);
        above.map(move |layer| down(critic, layer, batch)).chain([inputs])
    })
}

/// The gradient that a layer passes down to the units below it.
fn down(network: &NetworkLayout, layer: usize, batch: usize) -> Product {
    let units = network.hidden().layers[layer - 1];
    Product::new(units, network.layer_size(layer).1, batch, Transposed::Left)
}

fn output_layer(network: &NetworkLayout) -> usize {
    network.hidden().layers.len()
}

/// Every matrix product of a number of updates, in the order in which they run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Products {
    /// The number of updates.
    pub updates: u64,
    /// The products.
    pub products: Vec<Product>,
}

impl Products {
    /// Floating-point operations of an update, on average.
    pub fn flop_per_update(&self) -> u64 {
        self.products.iter().map(Product::flop).sum::<u64>() / self.updates.max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use faer::Mat;

    #[test]
    fn gradients_are_the_transposed_products() {
        let d = Mat::from_fn(4, 5, |i, j| (i * 5 + j) as f32 - 7.0);
        let x = Mat::from_fn(3, 5, |i, j| (i + 2 * j) as f32 - 3.0);
        let w = Mat::from_fn(4, 3, |i, j| (3 * i + j) as f32 - 5.0);
        let sum = |terms: &dyn Fn(usize) -> f32, count| (0..count).map(terms).sum::<f32>();
        let mut dw = Mat::full(4, 3, f32::NAN);
        weight_gradient(d.as_ref(), x.as_ref(), dw.as_mut());
        assert_eq!(dw, Mat::from_fn(4, 3, |i, j| sum(&|k| d[(i, k)] * x[(j, k)], 5)));
        let mut dx = Mat::full(3, 5, f32::NAN);
        input_gradient(w.as_ref(), d.as_ref(), dx.as_mut());
        assert_eq!(dx, Mat::from_fn(3, 5, |i, j| sum(&|k| w[(k, i)] * d[(k, j)], 4)));
    }
}
