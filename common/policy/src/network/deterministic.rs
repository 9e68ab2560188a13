//! The policy μ: the network's output, after tanh, scaled to the range of the actions.

use super::{ActionRange, Network, NetworkLayout};

/// The policy μ with buffers for a batch of observations. It does not own its parameters: each call borrows them.
#[derive(Clone, Debug)]
pub struct DeterministicPolicy {
    network: Network,
    range: ActionRange,
}

impl DeterministicPolicy {
    /// A policy with actions in `range`, for at most `batch` observations a call.
    ///
    /// # Panics
    /// If the network does not have one output for each element of an action.
    pub fn new(layout: NetworkLayout, range: ActionRange, batch: usize) -> Self {
        assert_eq!(
            layout.outputs(),
            range.width(),
            "one output for each element of an action"
        );
        Self {
            network: Network::new(layout, batch),
            range,
        }
    }

    /// The same policy, which normalises its observations or not.
    pub fn normalising(self, normalised: bool) -> Self {
        Self {
            network: self.network.normalising(normalised),
            ..self
        }
    }

    /// The layout of the parameters of [`forward`](Self::forward).
    pub fn layout(&self) -> &NetworkLayout {
        self.network.layout()
    }

    /// The range of its actions.
    pub fn range(&self) -> &ActionRange {
        &self.range
    }

    /// Writes μ(s) in environment units into `actions` for every observation s in `observations`, one after the other.
    /// Nothing is allocated.
    ///
    /// # Panics
    /// If the slices do not match the layout, or have more observations than the batch.
    pub fn forward(&mut self, parameters: &[f32], observations: &[f32], actions: &mut [f32]) {
        self.network.forward(parameters, observations, actions);
        for action in actions.chunks_exact_mut(self.range.width()) {
            for (element, z) in action.iter_mut().enumerate() {
                *z = self.range.action(element, z.tanh());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use shoal_base::space::Space;

    use super::super::Hidden;
    use super::*;

    #[test]
    fn actions_cover_the_range_including_both_ends() {
        let space = Space::boxed(&[(-1.0, 3.0), (-2.0, 2.0)]);
        let layout = NetworkLayout::new(1, Hidden::relu([1, 1]), 2);
        let mut policy = DeterministicPolicy::new(layout, ActionRange::new(&space).unwrap(), 3);
        // h1 = h2 = max(s, 0); z = ±1000 h2
        let parameters = [1.0, 0.0, 1.0, 0.0, 1000.0, -1000.0, 0.0, 0.0];
        let mut actions = [f32::NAN; 6];
        policy.forward(&parameters, &[1.0, 0.0, -1.0], &mut actions);
        assert_eq!(actions, [3.0, -2.0, 1.0, 0.0, 1.0, 0.0]);
    }
}
