//! A network as whoever acts evaluates it.

use super::{Activations, NetworkLayout};

/// A network without late inputs, with room for a batch. Its parameters are not its own: each call borrows them.
#[derive(Clone, Debug)]
pub struct Network {
    layout: NetworkLayout,
    /// Room for each hidden layer.
    hidden: Vec<Vec<f32>>,
}

impl Network {
    /// A network for at most `batch` inputs a call. `layout` has no late inputs, as a policy has none.
    pub fn new(layout: NetworkLayout, batch: usize) -> Self {
        let units = layout.hidden().layers;
        Self {
            layout,
            hidden: units.iter().map(|units| vec![0.0; units * batch]).collect(),
        }
    }

    /// How the parameters of [`forward`](Self::forward) are laid out.
    pub fn layout(&self) -> &NetworkLayout {
        &self.layout
    }

    /// Writes the linear outputs for every input in `inputs`, one after the other, into `output`.
    ///
    /// Panics when the slices do not fit the layout, or hold more than the batch. Nothing is allocated.
    pub fn forward(&mut self, parameters: &[f32], inputs: &[f32], output: &mut [f32]) {
        let batch = inputs.len() / self.layout.inputs();
        let units = self.layout.hidden().layers;
        let rooms = self.hidden.iter_mut().zip(units.iter());
        let to = Activations {
            joined: &mut [],
            hidden: rooms.map(|(room, units)| &mut room[..units * batch]),
            output,
        };
        self.layout.forward(parameters, inputs, &[], to);
    }
}
