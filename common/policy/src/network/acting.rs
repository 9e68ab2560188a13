//! The forward pass of a policy's network, as actors and evaluator use it.

use super::{Activations, NetworkLayout, normalise};

/// A network without action inputs, with buffers for a batch. It does not own its parameters: each call borrows them.
#[derive(Clone, Debug)]
pub struct Network {
    layout: NetworkLayout,
    batch: usize,
    /// A buffer for the outputs of each hidden layer.
    hidden: Vec<Vec<f32>>,
    /// A buffer for the normalised inputs; empty if they are not normalised.
    normalised: Vec<f32>,
}

impl Network {
    /// A network for at most `batch` inputs a call. `layout` must have no action inputs.
    pub fn new(layout: NetworkLayout, batch: usize) -> Self {
        let units = layout.hidden().layers;
        Self {
            layout,
            batch,
            normalised: Vec::new(),
            hidden: units.iter().map(|units| vec![0.0; units * batch]).collect(),
        }
    }

    /// The same network, which normalises its inputs or not.
    pub fn normalising(mut self, normalised: bool) -> Self {
        self.layout = self.layout.normalising(normalised);
        let inputs = if normalised {
            self.layout.inputs() * self.batch
        } else {
            0
        };
        self.normalised = vec![0.0; inputs];
        self
    }

    /// The layout of the parameters of [`forward`](Self::forward).
    pub fn layout(&self) -> &NetworkLayout {
        &self.layout
    }

    /// Writes the linear outputs for every input in `inputs`, one after the other, into `output`. Nothing is allocated.
    ///
    /// # Panics
    /// If the slices do not match the layout, or have more inputs than the batch.
    pub fn forward(&mut self, parameters: &[f32], inputs: &[f32], output: &mut [f32]) {
        let batch = inputs.len() / self.layout.inputs();
        let inputs = match self.layout.normalisation(parameters) {
            None => inputs,
            Some(normalisation) => {
                let normalised = &mut self.normalised[..inputs.len()];
                normalised.copy_from_slice(inputs);
                normalise(normalised, normalisation);
                normalised
            }
        };
        let units = self.layout.hidden().layers;
        let buffers = self.hidden.iter_mut().zip(units.iter());
        let to = Activations {
            joined: &mut [],
            hidden: buffers.map(|(buffer, units)| &mut buffer[..units * batch]),
            output,
        };
        self.layout.forward(parameters, inputs, &[], to);
    }
}
