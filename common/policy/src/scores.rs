//! A score for every action: the logits of a softmax policy, or the row of a table of action-values.

use super::PolicyLayout;
use crate::network::{Network, NetworkLayout};

/// Computes a score for every action, for a batch of observations.
#[derive(Clone, Debug)]
pub struct Scores {
    source: Source,
    actions: usize,
    scores: Vec<f32>,
}

#[derive(Clone, Debug)]
enum Source {
    Network(Network),
    Table { states: usize },
}

impl Scores {
    /// The logits of a softmax policy, for at most `batch` observations a call.
    pub(super) fn softmax(network: NetworkLayout, batch: usize) -> Self {
        Self {
            source: Source::Network(Network::new(network, batch)),
            actions: network.outputs(),
            scores: vec![0.0; network.outputs() * batch],
        }
    }

    /// The rows of a table of action-values, for at most `batch` observations a call.
    pub(super) fn table(states: usize, actions: usize, batch: usize) -> Self {
        Self {
            source: Source::Table { states },
            actions,
            scores: vec![0.0; actions * batch],
        }
    }

    /// The layout of the parameters of [`of`](Self::of).
    pub fn layout(&self) -> PolicyLayout {
        match &self.source {
            Source::Network(network) => PolicyLayout::Softmax(*network.layout()),
            Source::Table { states } => PolicyLayout::Table {
                states: *states,
                actions: self.actions,
            },
        }
    }

    /// The number of actions.
    pub fn actions(&self) -> usize {
        self.actions
    }

    /// The scores of all actions for each of the observations, one observation after the other. A state beyond the
    /// table's last counts as its last. Nothing is allocated.
    ///
    /// # Panics
    /// If the slices do not match the layout, or have more observations than the batch.
    pub fn of(&mut self, parameters: &[f32], observations: &[f32]) -> impl Iterator<Item = &[f32]> {
        let actions = self.actions;
        let batch = match &mut self.source {
            Source::Network(network) => {
                let batch = observations.len() / network.layout().inputs();
                network.forward(parameters, observations, &mut self.scores[..actions * batch]);
                batch
            }
            Source::Table { states } => {
                for (scores, state) in self.scores.chunks_exact_mut(actions).zip(observations) {
                    let state = (*state as usize).min(*states - 1);
                    scores.copy_from_slice(&parameters[state * actions..][..actions]);
                }
                observations.len()
            }
        };
        self.scores[..actions * batch].chunks_exact(actions)
    }
}
