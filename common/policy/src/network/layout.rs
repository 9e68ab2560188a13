//! The place of each parameter.

use std::ops::Range;

use super::forward::Layer;
use super::hidden::{Activation, Hidden};

/// The sizes of a network, and with them the place of each of its parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkLayout {
    pub(super) inputs: usize,
    pub(super) hidden: Hidden,
    pub(super) late_inputs: usize,
    pub(super) outputs: usize,
}

/// A layer's place in the parameter slice.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LayerRange {
    /// The weights W, outputs × inputs.
    pub weights: Range<usize>,
    /// The biases b, one an output.
    pub biases: Range<usize>,
}

impl NetworkLayout {
    /// A policy μ: observations to actions.
    pub fn policy(observation: usize, hidden: Hidden, action: usize) -> Self {
        Self {
            inputs: observation,
            hidden,
            late_inputs: 0,
            outputs: action,
        }
    }

    /// An action-value function Q: observations, and actions as late inputs, to one value.
    pub fn critic(observation: usize, hidden: Hidden, action: usize) -> Self {
        Self {
            inputs: observation,
            hidden,
            late_inputs: action,
            outputs: 1,
        }
    }

    /// Numbers in an input vector, without late inputs.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// The hidden layers.
    pub fn hidden(&self) -> Hidden {
        self.hidden
    }

    /// Numbers in a vector of late inputs.
    pub fn late_inputs(&self) -> usize {
        self.late_inputs
    }

    /// Numbers in an output vector.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// The layer that the late inputs enter, from 0: the second one, or the only hidden one. `None` where there are none.
    pub fn late_layer(&self) -> Option<usize> {
        let second = self.hidden.layers.len().min(2) - 1;
        (self.late_inputs > 0).then_some(second)
    }

    /// The `(inputs, outputs)` of a layer, from 0; its inputs end with the late ones where they enter there. The hidden layers
    /// come first, and the output layer is the last.
    pub fn layer_size(&self, layer: usize) -> (usize, usize) {
        let units = &*self.hidden.layers;
        let below = layer.checked_sub(1).map_or(self.inputs, |below| units[below]);
        let late = if self.late_layer() == Some(layer) {
            self.late_inputs
        } else {
            0
        };
        (below + late, units.get(layer).copied().unwrap_or(self.outputs))
    }

    /// The `(inputs, outputs)` of every layer: of the hidden ones and the output layer.
    pub fn layer_sizes(&self) -> impl Iterator<Item = (usize, usize)> {
        (0..=self.hidden.layers.len()).map(|layer| self.layer_size(layer))
    }

    /// Where every layer lies in the parameter slice.
    pub fn layer_ranges(&self) -> impl Iterator<Item = LayerRange> {
        self.layer_sizes().scan(0, |end, (inputs, outputs)| {
            let weights = *end..*end + outputs * inputs;
            let biases = weights.end..weights.end + outputs;
            *end = biases.end;
            Some(LayerRange { weights, biases })
        })
    }

    /// Where a layer, from 0, lies in the parameter slice.
    pub fn layer_range(&self, layer: usize) -> LayerRange {
        let start = self.layer_sizes().take(layer).map(parameters).sum();
        let (inputs, outputs) = self.layer_size(layer);
        let weights = start..start + outputs * inputs;
        LayerRange {
            biases: weights.end..weights.end + outputs,
            weights,
        }
    }

    /// Parameters of the network: the length of its slice.
    pub fn parameters(&self) -> usize {
        self.layer_sizes().map(parameters).sum()
    }

    /// Every layer of a slice of `parameters()` numbers.
    pub fn layers<'a>(&self, parameters: &'a [f32]) -> impl Iterator<Item = Layer<'a>> {
        self.layer_ranges().map(|range| Layer::at(range, parameters))
    }

    /// A layer, from 0, of a slice of `parameters()` numbers.
    pub fn layer<'a>(&self, layer: usize, parameters: &'a [f32]) -> Layer<'a> {
        Layer::at(self.layer_range(layer), parameters)
    }

    /// A number that two layouts share only if they read parameters alike (FNV-1a over the sizes).
    ///
    /// That of two ReLU layers is the one of files from before there were others. Any other list is followed by
    /// its length and the activation, so that no two layouts give the same numbers.
    pub fn fingerprint(&self) -> u64 {
        let Hidden { layers, activation } = self.hidden;
        let marks = match (layers.len(), activation) {
            (2, Activation::Relu) => None,
            (count, Activation::Relu) => Some([count, 0]),
            (count, Activation::Tanh) => Some([count, 1]),
        };
        let sizes = [self.inputs].into_iter().chain(layers.iter().copied());
        let sizes = sizes.chain([self.late_inputs, self.outputs]);
        let bytes = (sizes.chain(marks.into_iter().flatten())).flat_map(|size| (size as u64).to_le_bytes());
        bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        })
    }
}

/// Parameters of a layer of this size.
fn parameters((inputs, outputs): (usize, usize)) -> usize {
    (inputs + 1) * outputs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ranges_cover_the_parameters_without_gap_or_overlap() {
        for (hidden, expected) in [
            (Hidden::relu([5]), (3 + 2) * 5 + 5 + 5 + 1),
            (Hidden::relu([5, 4]), 3 * 5 + 5 + (5 + 2) * 4 + 4 + 4 + 1),
            (Hidden::tanh([5, 4, 6]), 3 * 5 + 5 + (5 + 2) * 4 + 4 + 4 * 6 + 6 + 6 + 1),
        ] {
            let layout = NetworkLayout::critic(3, hidden, 2);
            let mut end = 0;
            for (number, range) in layout.layer_ranges().enumerate() {
                assert_eq!(range, layout.layer_range(number));
                assert_eq!(range.weights.start, end);
                assert_eq!(range.biases.start, range.weights.end);
                end = range.biases.end;
            }
            assert_eq!(end, layout.parameters());
            assert_eq!(end, expected);
        }
    }

    #[test]
    fn fingerprints_tell_layouts_apart() {
        let layouts = [
            NetworkLayout::policy(3, Hidden::relu([400, 300]), 1),
            NetworkLayout::policy(4, Hidden::relu([400, 300]), 1),
            NetworkLayout::policy(3, Hidden::relu([300, 400]), 1),
            NetworkLayout::policy(3, Hidden::relu([400, 300]), 2),
            NetworkLayout::critic(3, Hidden::relu([400, 300]), 1),
            NetworkLayout::policy(3, Hidden::tanh([400, 300]), 1),
            NetworkLayout::policy(3, Hidden::relu([400]), 1),
            NetworkLayout::policy(3, Hidden::tanh([400]), 1),
            NetworkLayout::policy(3, Hidden::relu([400, 300, 300]), 1),
            // The same numbers in the same order as a critic of two layers.
            NetworkLayout::critic(3, Hidden::relu([400, 300]), 2),
            NetworkLayout::critic(3, Hidden::tanh([400, 300]), 2),
            NetworkLayout::critic(3, Hidden::relu([400, 300, 2]), 1),
        ];
        let fingerprints: std::collections::HashSet<u64> = layouts.iter().map(NetworkLayout::fingerprint).collect();
        assert_eq!(fingerprints.len(), layouts.len());
        // In the headers of policies that earlier versions wrote.
        assert_eq!(layouts[0].fingerprint(), 0x879f_248f_4c7e_52a3);
    }
}
