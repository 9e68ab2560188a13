//! A score for every action: the logits of a softmax policy, or the row of a table of action-values.

use super::PolicyLayout;
use crate::network::{Activations, NetworkLayout};

/// Says what every action is worth, for a batch of observations.
#[derive(Clone, Debug)]
pub struct Scores {
    source: Source,
    actions: usize,
    h1: Vec<f32>,
    h2: Vec<f32>,
    scores: Vec<f32>,
}

#[derive(Clone, Copy, Debug)]
enum Source {
    Network(NetworkLayout),
    Table { states: usize },
}

impl Scores {
    /// The logits of a softmax policy, for at most `batch` observations a call.
    pub(super) fn softmax(network: NetworkLayout, batch: usize) -> Self {
        let [h1, h2] = network.hidden().map(|units| vec![0.0; units * batch]);
        Self {
            source: Source::Network(network),
            actions: network.outputs(),
            h1,
            h2,
            scores: vec![0.0; network.outputs() * batch],
        }
    }

    /// The rows of a table of action-values, for at most `batch` observations a call.
    pub(super) fn table(states: usize, actions: usize, batch: usize) -> Self {
        Self {
            source: Source::Table { states },
            actions,
            h1: Vec::new(),
            h2: Vec::new(),
            scores: vec![0.0; actions * batch],
        }
    }

    /// What the parameters of [`of`](Self::of) are.
    pub fn layout(&self) -> PolicyLayout {
        match self.source {
            Source::Network(network) => PolicyLayout::Softmax(network),
            Source::Table { states } => PolicyLayout::Table {
                states,
                actions: self.actions,
            },
        }
    }

    /// How many actions there are.
    pub fn actions(&self) -> usize {
        self.actions
    }

    /// The scores of all actions for each of the observations, one observation after the other.
    ///
    /// A state beyond the table's last counts as its last. Panics when the slices do not fit the layout, or hold more than
    /// the batch. Nothing is allocated.
    pub fn of(&mut self, parameters: &[f32], observations: &[f32]) -> impl Iterator<Item = &[f32]> {
        let actions = self.actions;
        let batch = match self.source {
            Source::Network(network) => {
                let batch = observations.len() / network.inputs();
                let [h1, h2] = network.hidden().map(|units| units * batch);
                let to = Activations {
                    h1: &mut self.h1[..h1],
                    h2: &mut self.h2[..h2],
                    output: &mut self.scores[..actions * batch],
                };
                network.forward(parameters, observations, &[], to);
                batch
            }
            Source::Table { states } => {
                for (scores, state) in self.scores.chunks_exact_mut(actions).zip(observations) {
                    let state = (*state as usize).min(states - 1);
                    scores.copy_from_slice(&parameters[state * actions..][..actions]);
                }
                observations.len()
            }
        };
        self.scores[..actions * batch].chunks_exact(actions)
    }
}
