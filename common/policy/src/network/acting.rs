//! The forward pass of a policy's network, as actors and evaluator use it.

use super::{Activations, NetworkLayout};

/// A network without late inputs, with buffers for a batch. It does not own its parameters: each call borrows them.
#[derive(Clone, Debug)]
pub struct Network {
    layout: NetworkLayout,
    /// A buffer for the outputs of each hidden layer.
    hidden: Vec<Vec<f32>>,
}

impl Network {
    /// A network for at most `batch` inputs a call. `layout` must have no late inputs.
    pub fn new(layout: NetworkLayout, batch: usize) -> Self {
        let units = layout.hidden().layers;
        Self {
            layout,
            hidden: units.iter().map(|units| vec![0.0; units * batch]).collect(),
        }
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
