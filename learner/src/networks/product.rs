//! The matrix products of a gradient step: those of the backward pass, and a list of all of them for the benchmark.

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
    /// Floating-point operations: a multiplication and an addition for each term.
    pub fn flop(&self) -> u64 {
        2 * (self.m * self.k * self.n) as u64
    }
}

/// Every matrix product of one DDPG gradient step, in the order in which they run.
///
/// With the thesis's networks, three observations and a batch of 64 they take 140 million operations, nearly all of
/// them in nine products of size 300 × 400 × 64.
pub fn products_of_update(actor: &NetworkLayout, critic: &NetworkLayout, batch: usize) -> Vec<Product> {
    let product = |m, k, n, transposed| Product { m, k, n, transposed };
    let forward = |net: &NetworkLayout| -> Vec<Product> {
        let sizes = net.layer_sizes();
        sizes.map(|(i, o)| product(o, i, batch, Transposed::Neither)).collect()
    };
    // The gradient that a layer passes down to the units below it.
    let down = |net: &NetworkLayout, layer: usize| {
        let units = net.hidden().layers[layer - 1];
        product(units, net.layer_size(layer).1, batch, Transposed::Left)
    };
    let output_layer = |net: &NetworkLayout| net.hidden().layers.len();
    let backward = |net: &NetworkLayout| -> Vec<Product> {
        let of_layer = |layer| {
            let (inputs, outputs) = net.layer_size(layer);
            let weights = product(outputs, batch, inputs, Transposed::Right);
            [weights].into_iter().chain((layer > 0).then(|| down(net, layer)))
        };
        (0..=output_layer(net)).rev().flat_map(of_layer).collect()
    };
    let action_gradient: Vec<Product> = critic.late_layer().map_or_else(Vec::new, |late| {
        let above = (late + 1..=output_layer(critic)).rev();
        let units = critic.layer_size(late).1;
        let actions = product(critic.late_inputs(), units, batch, Transposed::Left);
        above.map(|layer| down(critic, layer)).chain([actions]).collect()
    });
    let target = [forward(actor), forward(critic)];
    let ascent = [forward(actor), forward(critic)];
    (target.into_iter().flatten())
        .chain(forward(critic))
        .chain(backward(critic))
        .chain(ascent.into_iter().flatten())
        .chain(action_gradient)
        .chain(backward(actor))
        .collect()
}

/// Floating-point operations of the matrix products of one DDPG gradient step: 140 million for Pendulum at batch 64.
pub fn flop_per_update(actor: &NetworkLayout, critic: &NetworkLayout, batch: usize) -> u64 {
    products_of_update(actor, critic, batch).iter().map(Product::flop).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use faer::Mat;
    use shoal_common::network::Hidden;

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

    #[test]
    fn a_gradient_step_of_the_thesis_takes_140_million_operations() {
        let (actor, critic) = (
            NetworkLayout::policy(3, Hidden::relu([400, 300]), 1),
            NetworkLayout::critic(3, Hidden::relu([400, 300]), 1),
        );
        let products = products_of_update(&actor, &critic, 64);
        assert_eq!(products.iter().filter(|p| p.flop() > 15_000_000).count(), 9);
        assert_eq!((flop_per_update(&actor, &critic, 64) as f64 / 1e6).round(), 140.0);
    }
}
