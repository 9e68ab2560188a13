//! An actor's state between two chunks: all that another process needs to take its place and continue with the same
//! bits.

use shoal_common::actor_snapshot::ActorSnapshotLayout;

/// The state of an actor and of its environment server.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ActorSnapshot {
    /// The state of the environments, as their server returned it.
    pub(crate) environments: Vec<u64>,
    /// Steps of each environment since the actor's random stream began.
    pub(crate) step: u64,
    /// The state of the exploration, one environment after another.
    pub(crate) exploration: Vec<f64>,
    /// Returns of the current episodes.
    pub(crate) returns: Vec<f64>,
    /// Lengths of the current episodes.
    pub(crate) lengths: Vec<u32>,
    /// The state of [`NStepTransitions`](crate::n_step::NStepTransitions).
    pub(crate) n_step: Vec<u64>,
}

impl ActorSnapshot {
    /// The words that follow a chunk's rows.
    pub(crate) fn words(&self) -> Vec<u64> {
        let own = self
            .exploration
            .iter()
            .chain(&self.returns)
            .map(|number| number.to_bits());
        let lengths = self.lengths.iter().map(|length| u64::from(*length));
        let step = std::iter::once(self.step);
        self.environments
            .iter()
            .copied()
            .chain(step)
            .chain(own)
            .chain(lengths)
            .chain(self.n_step.iter().copied())
            .collect()
    }

    /// Reads a snapshot of this layout; `None` if there are more or fewer words.
    pub(crate) fn read(words: &[u64], layout: &ActorSnapshotLayout) -> Option<Self> {
        let (environments, rest) = words.split_at_checked(layout.environments)?;
        let (step, rest) = rest.split_first()?;
        let (exploration, rest) = rest.split_at_checked(layout.exploration)?;
        let (returns, rest) = rest.split_at_checked(layout.envs)?;
        let (lengths, rest) = rest.split_at_checked(layout.envs)?;
        let numbers = |words: &[u64]| words.iter().map(|bits| f64::from_bits(*bits)).collect();
        (rest.len() == layout.n_step).then(|| Self {
            environments: environments.into(),
            step: *step,
            exploration: numbers(exploration),
            returns: numbers(returns),
            // Every length was written from a `u32`.
            lengths: lengths.iter().map(|length| *length as u32).collect(),
            n_step: rest.into(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_snapshot_reads_back_and_other_words_are_refused() {
        let layout = ActorSnapshotLayout {
            environments: 10,
            exploration: 4,
            envs: 2,
            n_step: 3,
        };
        let snapshot = ActorSnapshot {
            environments: (0..10).collect(),
            step: 77,
            exploration: vec![0.5, -0.0, f64::MIN_POSITIVE, 3.0],
            returns: vec![-1200.5, 0.0],
            lengths: vec![199, 0],
            n_step: vec![7, 8, 9],
        };
        let words = snapshot.words();
        assert_eq!(words.len(), layout.words());
        assert_eq!(ActorSnapshot::read(&words, &layout), Some(snapshot));
        assert_eq!(ActorSnapshot::read(&words[1..], &layout), None);
        assert_eq!(ActorSnapshot::read(&[&words[..], &[0]].concat(), &layout), None);
        assert_eq!(ActorSnapshot::read(&[], &layout), None);
    }
}
