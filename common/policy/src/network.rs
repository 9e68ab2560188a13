//! The networks' shape, stated once for every process: where each weight lies in a flat parameter slice, and the forward
//! pass that reads the slice in place, be it the learner's own memory or a sample in shared memory.
//!
//! Every network has two hidden layers of ReLU units and a linear output. Its parameters are
//!
//! ```text
//! [ W1 | b1 | W2 | b2 | W3 | b3 ]        each W column-major, outputs × inputs
//! ```
//!
//! *Late inputs* enter at the second hidden layer: they are the last columns of W2. A critic takes its action there
//! (thesis, section 4.3.1); a policy has none. A batch of vectors is a column-major matrix, one vector after the other.

mod forward;
mod policy;

use std::ops::Range;

pub use forward::{Activations, Layer, matrix, matrix_mut};
pub use policy::{ActionRange, ActionRangeError, PolicyNetwork};

/// The sizes of a network, and with them the place of each of its parameters.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkLayout {
    inputs: usize,
    hidden: [usize; 2],
    late_inputs: usize,
    outputs: usize,
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
    pub fn policy(observation: usize, hidden: [usize; 2], action: usize) -> Self {
        Self {
            inputs: observation,
            hidden,
            late_inputs: 0,
            outputs: action,
        }
    }

    /// An action-value function Q: observations, and actions as late inputs, to one value.
    pub fn critic(observation: usize, hidden: [usize; 2], action: usize) -> Self {
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

    /// Units in each hidden layer.
    pub fn hidden(&self) -> [usize; 2] {
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

    /// The `(inputs, outputs)` of each of the three layers; the second layer's inputs end with the late ones.
    pub fn layer_sizes(&self) -> [(usize, usize); 3] {
        let [h1, h2] = self.hidden;
        [(self.inputs, h1), (h1 + self.late_inputs, h2), (h2, self.outputs)]
    }

    /// Where each of the three layers lies in the parameter slice.
    pub fn layer_ranges(&self) -> [LayerRange; 3] {
        let mut end = 0;
        self.layer_sizes().map(|(inputs, outputs)| {
            let weights = end..end + outputs * inputs;
            let biases = weights.end..weights.end + outputs;
            end = biases.end;
            LayerRange { weights, biases }
        })
    }

    /// Parameters of the network: the length of its slice.
    pub fn parameters(&self) -> usize {
        self.layer_sizes()
            .iter()
            .map(|(inputs, outputs)| (inputs + 1) * outputs)
            .sum()
    }

    /// The three layers of a slice of `parameters()` numbers.
    pub fn layers<'a>(&self, parameters: &'a [f32]) -> [Layer<'a>; 3] {
        self.layer_ranges().map(|range| Layer {
            weights: &parameters[range.weights],
            biases: &parameters[range.biases],
        })
    }

    /// A number that two layouts share only if they read parameters alike (FNV-1a over the sizes).
    pub fn fingerprint(&self) -> u64 {
        let [h1, h2] = self.hidden;
        let sizes = [self.inputs, h1, h2, self.late_inputs, self.outputs];
        let bytes = sizes.iter().flat_map(|&size| (size as u64).to_le_bytes());
        bytes.fold(0xcbf2_9ce4_8422_2325, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ranges_cover_the_parameters_without_gap_or_overlap() {
        let layout = NetworkLayout::critic(3, [5, 4], 2);
        let mut end = 0;
        for range in layout.layer_ranges() {
            assert_eq!(range.weights.start, end);
            assert_eq!(range.biases.start, range.weights.end);
            end = range.biases.end;
        }
        assert_eq!(end, layout.parameters());
        assert_eq!(end, 3 * 5 + 5 + (5 + 2) * 4 + 4 + 4 + 1);
    }

    #[test]
    fn fingerprints_tell_layouts_apart() {
        let policy = NetworkLayout::policy(3, [400, 300], 1);
        assert_eq!(
            policy.fingerprint(),
            NetworkLayout::policy(3, [400, 300], 1).fingerprint()
        );
        for other in [
            NetworkLayout::policy(4, [400, 300], 1),
            NetworkLayout::policy(3, [300, 400], 1),
            NetworkLayout::policy(3, [400, 300], 2),
            NetworkLayout::critic(3, [400, 300], 1),
        ] {
            assert_ne!(policy.fingerprint(), other.fingerprint());
        }
    }
}
