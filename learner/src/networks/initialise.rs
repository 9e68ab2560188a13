//! Initial weights of a network.

use rand::RngExt;
use shoal_common::network::NetworkLayout;
use shoal_common::stream::{Purpose, stream};

/// Bound of the output layer's weights and biases, so that the first actions and values are near the middle of their
/// range (Lillicrap et al. 2015, section 7).
const OUTPUT_BOUND: f32 = 3e-3;

/// Seeded initial weights: hidden layers uniform within ±1/√fan-in (including action inputs), the output layer within
/// ±3e-3.
///
/// `index` distinguishes the networks of one run.
pub fn small_output(layout: &NetworkLayout, seed: u64, index: u64) -> Vec<f32> {
    let output_layer = layout.hidden().layers.len();
    uniform(layout, seed, index, |layer, inputs| {
        if layer == output_layer {
            OUTPUT_BOUND
        } else {
            fan_in_bound(inputs)
        }
    })
}

/// As [`small_output`], but the output layer is uniform within ±1/√fan-in too, as is the default of PyTorch's layers.
pub fn fan_in(layout: &NetworkLayout, seed: u64, index: u64) -> Vec<f32> {
    uniform(layout, seed, index, |_, inputs| fan_in_bound(inputs))
}

/// Weights and biases uniform within a layer's bound, which follows from the layer's number and its inputs.
fn uniform(layout: &NetworkLayout, seed: u64, index: u64, bound: impl Fn(usize, usize) -> f32) -> Vec<f32> {
    let mut stream = stream(seed, Purpose::Initialisation, index, 0);
    let mut parameters = Vec::with_capacity(layout.parameters());
    for (layer, (inputs, outputs)) in layout.layer_sizes().enumerate() {
        let bound = bound(layer, inputs);
        parameters.extend((0..(inputs + 1) * outputs).map(|_| (2.0 * stream.random::<f32>() - 1.0) * bound));
    }
    parameters
}

/// Seeded initial weights by the default of the thesis's tool (Glorot and Bengio 2010): each layer's weights uniform
/// within ±√(6 / (inputs + outputs)), biases zero.
///
/// `index` distinguishes the networks of one run.
pub fn glorot(layout: &NetworkLayout, seed: u64, index: u64) -> Vec<f32> {
    let mut stream = stream(seed, Purpose::Initialisation, index, 0);
    let mut parameters = vec![0.0; layout.parameters()];
    for (range, (inputs, outputs)) in layout.layer_ranges().zip(layout.layer_sizes()) {
        let bound = (6.0 / (inputs + outputs) as f32).sqrt();
        for weight in &mut parameters[range.weights] {
            *weight = (2.0 * stream.random::<f32>() - 1.0) * bound;
        }
    }
    parameters
}

fn fan_in_bound(inputs: usize) -> f32 {
    1.0 / (inputs as f32).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use shoal_common::network::Hidden;

    #[test]
    fn glorot_weights_fill_their_bounds_and_biases_are_zero() {
        let layout = NetworkLayout::new(4, Hidden::relu([60, 40]), 2);
        let parameters = glorot(&layout, 7, 0);
        let bounds = [6.0 / 64.0, 6.0 / 100.0, 6.0 / 42.0].map(f32::sqrt);
        for (range, bound) in layout.layer_ranges().zip(bounds) {
            let largest = parameters[range.weights]
                .iter()
                .fold(0.0_f32, |most, x| most.max(x.abs()));
            assert!(largest <= bound && largest > 0.9 * bound, "{largest} of {bound}");
            assert!(parameters[range.biases].iter().all(|bias| *bias == 0.0));
        }
    }

    #[test]
    fn each_layer_fills_its_bounds_and_stays_within_them() {
        for (hidden, inputs) in [
            (Hidden::relu([40, 30]), vec![3.0, 42.0]),
            (Hidden::relu([40]), vec![5.0]),
            (Hidden::tanh([40, 30, 20]), vec![3.0, 42.0, 30.0]),
        ] {
            let layout = NetworkLayout::critic(3, hidden, 2);
            let parameters = small_output(&layout, 7, 1);
            assert_eq!(parameters.len(), layout.parameters());
            let bounds = inputs.into_iter().map(|inputs: f32| 1.0 / inputs.sqrt()).chain([3e-3]);
            for (range, bound) in layout.layer_ranges().zip(bounds) {
                let layer = &parameters[range.weights.start..range.biases.end];
                let greatest = layer.iter().fold(0f32, |greatest, x| greatest.max(x.abs()));
                assert!(greatest <= bound && greatest > 0.9 * bound, "{greatest} for {bound}");
                let mean = layer.iter().sum::<f32>() / layer.len() as f32;
                assert!(mean.abs() < 0.3 * bound, "mean {mean} for {bound}");
            }
        }
    }

    #[test]
    fn seed_and_index_determine_the_weights() {
        let layout = NetworkLayout::new(3, Hidden::relu([8, 6]), 1);
        assert_eq!(small_output(&layout, 1, 0), small_output(&layout, 1, 0));
        assert_ne!(small_output(&layout, 1, 0), small_output(&layout, 2, 0));
        assert_ne!(small_output(&layout, 1, 0), small_output(&layout, 1, 1));
    }
}
