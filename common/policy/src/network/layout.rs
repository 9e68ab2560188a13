//! The layout of a network's parameters.

use std::ops::Range;

use super::forward::Layer;
use super::hidden::{Activation, Hidden};

/// The sizes of a network, which determine the place of each of its parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkLayout {
    pub(super) inputs: usize,
    pub(super) hidden: Hidden,
    pub(super) action_inputs: usize,
    /// The layer that the action inputs enter, counted from 0. 0 if there are none.
    action_layer: usize,
    pub(super) outputs: usize,
    normalised: bool,
}

/// A layer's place in the parameter slice.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LayerRange {
    /// The weights W, outputs × inputs.
    pub weights: Range<usize>,
    /// The biases b, one for each output.
    pub biases: Range<usize>,
}

impl NetworkLayout {
    /// A network from `inputs` to `outputs` numbers, without action inputs: a policy, or the values of a state or of
    /// all actions.
    pub fn new(inputs: usize, hidden: Hidden, outputs: usize) -> Self {
        Self {
            inputs,
            hidden,
            action_inputs: 0,
            action_layer: 0,
            outputs,
            normalised: false,
        }
    }

    /// An action-value function Q(s, a): from observations and actions to one value. The actions enter at the second
    /// hidden layer, or at the only one.
    pub fn critic(observation: usize, hidden: Hidden, action: usize) -> Self {
        Self {
            action_layer: hidden.layers.len().min(2) - 1,
            ..Self::joined_critic(observation, hidden, action)
        }
    }

    /// As [`critic`](Self::critic), but the actions enter at the first layer: its input is (s, a).
    pub fn joined_critic(observation: usize, hidden: Hidden, action: usize) -> Self {
        Self {
            inputs: observation,
            hidden,
            action_inputs: action,
            action_layer: 0,
            outputs: 1,
            normalised: false,
        }
    }

    /// The same network, which normalises its inputs or not. If it does, a mean and a factor for each input follow the
    /// layers in the parameter slice ([`normalise`](super::normalise())).
    pub fn normalising(self, normalised: bool) -> Self {
        Self { normalised, ..self }
    }

    /// Whether it normalises its inputs.
    pub fn normalises(&self) -> bool {
        self.normalised
    }

    /// Numbers in an input vector, without action inputs.
    pub fn inputs(&self) -> usize {
        self.inputs
    }

    /// The hidden layers.
    pub fn hidden(&self) -> Hidden {
        self.hidden
    }

    /// Numbers in an action; 0 if the network has no action inputs.
    pub fn action_inputs(&self) -> usize {
        self.action_inputs
    }

    /// Numbers in an output vector.
    pub fn outputs(&self) -> usize {
        self.outputs
    }

    /// The layer that the action inputs enter, counted from 0. `None` if there are no action inputs.
    pub fn action_layer(&self) -> Option<usize> {
        (self.action_inputs > 0).then_some(self.action_layer)
    }

    /// The `(inputs, outputs)` of a layer, counted from 0. The output layer comes after the hidden layers. The inputs
    /// include the action inputs if those enter at this layer.
    pub fn layer_size(&self, layer: usize) -> (usize, usize) {
        let units = &*self.hidden.layers;
        let below = layer.checked_sub(1).map_or(self.inputs, |below| units[below]);
        let action = if self.action_layer() == Some(layer) {
            self.action_inputs
        } else {
            0
        };
        (below + action, units.get(layer).copied().unwrap_or(self.outputs))
    }

    /// The `(inputs, outputs)` of every hidden layer and of the output layer.
    pub fn layer_sizes(&self) -> impl Iterator<Item = (usize, usize)> {
        (0..=self.hidden.layers.len()).map(|layer| self.layer_size(layer))
    }

    /// The place of every layer in the parameter slice.
    pub fn layer_ranges(&self) -> impl Iterator<Item = LayerRange> {
        self.layer_sizes().scan(0, |end, (inputs, outputs)| {
            let weights = *end..*end + outputs * inputs;
            let biases = weights.end..weights.end + outputs;
            *end = biases.end;
            Some(LayerRange { weights, biases })
        })
    }

    /// The place of a layer, counted from 0, in the parameter slice.
    pub fn layer_range(&self, layer: usize) -> LayerRange {
        let start = self.layer_sizes().take(layer).map(parameters).sum();
        let (inputs, outputs) = self.layer_size(layer);
        let weights = start..start + outputs * inputs;
        LayerRange {
            biases: weights.end..weights.end + outputs,
            weights,
        }
    }

    /// The number of parameters: the length of the slice.
    pub fn parameters(&self) -> usize {
        let layers: usize = self.layer_sizes().map(parameters).sum();
        layers + if self.normalised { 2 * self.inputs } else { 0 }
    }

    /// The mean and the factor of each input, if it normalises them, of a slice of `parameters()` numbers.
    pub fn normalisation<'a>(&self, parameters: &'a [f32]) -> Option<(&'a [f32], &'a [f32])> {
        let layers = self.parameters() - if self.normalised { 2 * self.inputs } else { 0 };
        self.normalised.then(|| parameters[layers..].split_at(self.inputs))
    }

    /// All layers of a slice of `parameters()` numbers.
    pub fn layers<'a>(&self, parameters: &'a [f32]) -> impl Iterator<Item = Layer<'a>> {
        self.layer_ranges().map(|range| Layer::at(range, parameters))
    }

    /// A layer, counted from 0, of a slice of `parameters()` numbers.
    pub fn layer<'a>(&self, layer: usize, parameters: &'a [f32]) -> Layer<'a> {
        Layer::at(self.layer_range(layer), parameters)
    }

    /// The fingerprint: two layouts have the same fingerprint only if they read parameters alike (FNV-1a over the
    /// sizes).
    ///
    /// With two ReLU layers it is the fingerprint in files from before other networks existed. For any other list the
    /// length and the activation are appended, and a 1 if action inputs enter at the first of several layers, or a 2 if
    /// the inputs are normalised, so that no two layouts hash the same numbers.
    pub fn fingerprint(&self) -> u64 {
        let Hidden { layers, activation } = self.hidden;
        let joined = (layers.len() > 1 && self.action_layer() == Some(0)).then_some(1);
        let normalised = self.normalised.then_some(2);
        let others = joined.into_iter().chain(normalised);
        let marks = match (layers.len(), activation) {
            (2, Activation::Relu) if others.clone().next().is_none() => None,
            (count, Activation::Relu) => Some([count, 0]),
            (count, Activation::Tanh) => Some([count, 1]),
        };
        let sizes = [self.inputs].into_iter().chain(layers.iter().copied());
        let sizes = sizes.chain([self.action_inputs, self.outputs]);
        let bytes =
            (sizes.chain(marks.into_iter().flatten()).chain(others)).flat_map(|size| (size as u64).to_le_bytes());
        bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        })
    }
}

/// The number of parameters of a layer of this size.
fn parameters((inputs, outputs): (usize, usize)) -> usize {
    (inputs + 1) * outputs
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ranges_cover_the_parameters_without_gaps_or_overlaps() {
        let critic = |hidden| NetworkLayout::critic(3, hidden, 2);
        for (layout, expected) in [
            (critic(Hidden::relu([5])), (3 + 2) * 5 + 5 + 5 + 1),
            (critic(Hidden::relu([5, 4])), 3 * 5 + 5 + (5 + 2) * 4 + 4 + 4 + 1),
            (
                critic(Hidden::tanh([5, 4, 6])),
                3 * 5 + 5 + (5 + 2) * 4 + 4 + 4 * 6 + 6 + 6 + 1,
            ),
            (
                NetworkLayout::joined_critic(3, Hidden::relu([5, 4]), 2),
                (3 + 2) * 5 + 5 + 5 * 4 + 4 + 4 + 1,
            ),
        ] {
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
    fn different_layouts_have_different_fingerprints() {
        let layouts = [
            NetworkLayout::new(3, Hidden::relu([400, 300]), 1),
            NetworkLayout::new(4, Hidden::relu([400, 300]), 1),
            NetworkLayout::new(3, Hidden::relu([300, 400]), 1),
            NetworkLayout::new(3, Hidden::relu([400, 300]), 2),
            NetworkLayout::critic(3, Hidden::relu([400, 300]), 1),
            NetworkLayout::new(3, Hidden::tanh([400, 300]), 1),
            NetworkLayout::new(3, Hidden::relu([400]), 1),
            NetworkLayout::new(3, Hidden::tanh([400]), 1),
            NetworkLayout::new(3, Hidden::relu([400, 300, 300]), 1),
            // The same numbers in the same order as for a critic with two layers.
            NetworkLayout::critic(3, Hidden::relu([400, 300]), 2),
            NetworkLayout::critic(3, Hidden::tanh([400, 300]), 2),
            NetworkLayout::critic(3, Hidden::relu([400, 300, 2]), 1),
            NetworkLayout::new(3, Hidden::relu([400, 300]), 1).normalising(true),
            NetworkLayout::joined_critic(3, Hidden::relu([400, 300]), 1),
            NetworkLayout::joined_critic(3, Hidden::tanh([400, 300]), 1),
        ];
        let fingerprints: std::collections::HashSet<u64> = layouts.iter().map(NetworkLayout::fingerprint).collect();
        assert_eq!(fingerprints.len(), layouts.len());
        // This fingerprint is in the headers of policies from earlier versions.
        assert_eq!(layouts[0].fingerprint(), 0x879f_248f_4c7e_52a3);
    }
}
