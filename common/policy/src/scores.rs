//! A score for every action: the logits of a softmax policy, or action-values of a network or a table.

use super::PolicyLayout;
use crate::network::{Network, NetworkLayout};

/// Computes a score for every action, for a batch of observations.
#[derive(Clone, Debug)]
pub struct Scores {
    function: ScoreFunction,
    actions: usize,
    scores: Vec<f32>,
}

#[derive(Clone, Debug)]
enum ScoreFunction {
    /// The logits of a softmax policy.
    Logits(Network),
    /// Action-values.
    Values(Network),
    /// The heads of a dueling network, from which action-values follow.
    Dueling(Network),
    /// Action-values.
    Table { states: usize },
}

impl Scores {
    /// The logits of a softmax policy, for at most `batch` observations a call.
    pub(super) fn softmax(network: NetworkLayout, batch: usize) -> Self {
        Self::of_network(ScoreFunction::Logits(Network::new(network, batch)), network, batch)
    }

    /// The action-values that a network computes, for at most `batch` observations a call.
    pub(super) fn values(network: NetworkLayout, batch: usize) -> Self {
        Self::of_network(ScoreFunction::Values(Network::new(network, batch)), network, batch)
    }

    /// The action-values of a dueling network, whose outputs are V(s) and the advantages, for at most `batch`
    /// observations a call.
    pub(super) fn dueling(network: NetworkLayout, batch: usize) -> Self {
        let scores = Self::of_network(ScoreFunction::Dueling(Network::new(network, batch)), network, batch);
        Self {
            actions: network.outputs() - 1,
            ..scores
        }
    }

    fn of_network(function: ScoreFunction, network: NetworkLayout, batch: usize) -> Self {
        Self {
            function,
            actions: network.outputs(),
            scores: vec![0.0; network.outputs() * batch],
        }
    }

    /// The rows of a table of action-values, for at most `batch` observations a call.
    pub(super) fn table(states: usize, actions: usize, batch: usize) -> Self {
        Self {
            function: ScoreFunction::Table { states },
            actions,
            scores: vec![0.0; actions * batch],
        }
    }

    /// The same scores, of normalised observations or not. A table's observations are indices, which are never
    /// normalised.
    pub fn normalising(self, normalised: bool) -> Self {
        let function = match self.function {
            ScoreFunction::Logits(network) => ScoreFunction::Logits(network.normalising(normalised)),
            ScoreFunction::Values(network) => ScoreFunction::Values(network.normalising(normalised)),
            ScoreFunction::Dueling(network) => ScoreFunction::Dueling(network.normalising(normalised)),
            table @ ScoreFunction::Table { .. } => table,
        };
        Self { function, ..self }
    }

    /// The layout of the parameters of [`compute`](Self::compute).
    pub fn layout(&self) -> PolicyLayout {
        match &self.function {
            ScoreFunction::Logits(network) => PolicyLayout::Softmax(*network.layout()),
            ScoreFunction::Values(network) => PolicyLayout::ActionValues(*network.layout()),
            ScoreFunction::Dueling(network) => PolicyLayout::Dueling(*network.layout()),
            ScoreFunction::Table { states } => PolicyLayout::Table {
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
    pub fn compute(&mut self, parameters: &[f32], observations: &[f32]) -> impl Iterator<Item = &[f32]> {
        let actions = self.actions;
        let (batch, outputs) = match &mut self.function {
            ScoreFunction::Logits(network) | ScoreFunction::Values(network) | ScoreFunction::Dueling(network) => {
                let (batch, outputs) = (
                    observations.len() / network.layout().inputs(),
                    network.layout().outputs(),
                );
                network.forward(parameters, observations, &mut self.scores[..outputs * batch]);
                (batch, outputs)
            }
            ScoreFunction::Table { states } => {
                for (scores, state) in self.scores.chunks_exact_mut(actions).zip(observations) {
                    let state = (*state as usize).min(*states - 1);
                    scores.copy_from_slice(&parameters[state * actions..][..actions]);
                }
                (observations.len(), actions)
            }
        };
        if let ScoreFunction::Dueling(_) = self.function {
            self.scores[..outputs * batch]
                .chunks_exact_mut(outputs)
                .for_each(combine_heads);
        }
        self.scores[..outputs * batch]
            .chunks_exact(outputs)
            .map(move |scores| &scores[outputs - actions..])
    }
}

/// Turns the outputs V, A₁, A₂, … of a dueling network into V, Q₁, Q₂, …: Qᵢ = V + Aᵢ − mean of A (Wang et al. 2016,
/// equation 9).
pub fn combine_heads(heads: &mut [f32]) {
    if let [value, advantages @ ..] = heads {
        let shift = *value - advantages.iter().sum::<f32>() / advantages.len() as f32;
        advantages.iter_mut().for_each(|advantage| *advantage += shift);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_heads_of_a_dueling_network_become_action_values() {
        let mut heads = [10.0, 1.0, 2.0, 6.0];
        combine_heads(&mut heads);
        assert_eq!(heads, [10.0, 8.0, 9.0, 13.0]);
    }
}
