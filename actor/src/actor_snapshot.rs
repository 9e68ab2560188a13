//! Where an actor stands between two chunks: all that another one needs to go on in its place with the same bits.

use shoal_common::transition::ChunkLayout;

/// The actor's part of it, and its environment server's.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ActorSnapshot {
    /// The environments, as their server says it.
    pub(crate) snapshot: Vec<u64>,
    /// Steps of every environment since the actor's stream began.
    pub(crate) step: u64,
    /// The state of the noise, environment after environment.
    pub(crate) noise: Vec<f64>,
    /// Returns of the episodes under way.
    pub(crate) returns: Vec<f64>,
    /// Their lengths.
    pub(crate) lengths: Vec<u32>,
}

impl ActorSnapshot {
    /// As it travels behind a chunk's rows.
    pub(crate) fn words(&self) -> Vec<u64> {
        let own = self.noise.iter().chain(&self.returns).map(|number| number.to_bits());
        let lengths = self.lengths.iter().map(|length| u64::from(*length));
        let step = std::iter::once(self.step);
        self.snapshot
            .iter()
            .copied()
            .chain(step)
            .chain(own)
            .chain(lengths)
            .collect()
    }

    /// Reads the words of an actor with `envs` environments, whose noise has so many numbers; `None` where they are not so
    /// many as `layout` says.
    pub(crate) fn read(words: &[u64], layout: &ChunkLayout, envs: usize, noise: usize) -> Option<Self> {
        let snapshot = layout.actor_snapshot_words.checked_sub(1 + noise + 2 * envs)?;
        let (snapshot, rest) = words.split_at_checked(snapshot)?;
        let (step, rest) = rest.split_first()?;
        let (noise, rest) = rest.split_at_checked(noise)?;
        let (returns, lengths) = rest.split_at_checked(envs)?;
        let numbers = |words: &[u64]| words.iter().map(|bits| f64::from_bits(*bits)).collect();
        (lengths.len() == envs).then(|| Self {
            snapshot: snapshot.into(),
            step: *step,
            noise: numbers(noise),
            returns: numbers(returns),
            // An episode's length was a `u32` before it was a word.
            lengths: lengths.iter().map(|length| *length as u32).collect(),
        })
    }
}

#[cfg(test)]
mod tests {
    use shoal_common::transition::RowLayout;

    use super::*;

    #[test]
    fn it_reads_back_as_it_was_and_other_words_are_refused() {
        let layout = ChunkLayout {
            row: RowLayout::new(3, 2),
            rows: 4,
            actor_snapshot_words: 10 + 1 + 2 * (2 + 2),
        };
        let standing = ActorSnapshot {
            snapshot: (0..10).collect(),
            step: 77,
            noise: vec![0.5, -0.0, f64::MIN_POSITIVE, 3.0],
            returns: vec![-1200.5, 0.0],
            lengths: vec![199, 0],
        };
        let words = standing.words();
        assert_eq!(ActorSnapshot::read(&words, &layout, 2, 4), Some(standing));
        assert_eq!(ActorSnapshot::read(&words[1..], &layout, 2, 4), None);
        assert_eq!(ActorSnapshot::read(&[], &layout, 2, 4), None);
        let free = ChunkLayout {
            actor_snapshot_words: 0,
            ..layout
        };
        assert_eq!(ActorSnapshot::read(&words, &free, 2, 4), None);
    }
}
