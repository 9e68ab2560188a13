//! Random streams. Every random number of a run comes from one of them. A stream is named by seed, purpose, index and
//! incarnation, and a counter selects any position in it.

use rand::SeedableRng;
pub use rand_chacha::ChaCha8Rng as Stream;

/// What a stream is used for. The discriminants determine the numbers of existing runs: never change or reuse one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Start states and transitions of an environment server's environments.
    Environment = 1,
    /// Exploration noise of an actor.
    Exploration = 2,
    /// Rows of a minibatch.
    Sampling = 3,
    /// Initial weights of the networks.
    Initialisation = 4,
    /// Start states of evaluation episodes.
    Evaluation = 5,
    /// Random numbers within an update: TD3's noise on target actions, SAC's draws.
    Update = 6,
    /// States at which a policy is examined after the run.
    Analysis = 7,
}

/// The stream of `purpose` for the process `index` in its `incarnation`, under the run's `seed`.
///
/// The four words are the generator's key. With `set_stream` and `set_word_pos` the result is a counter-based generator
/// (ChaCha with 8 rounds), which gives the same numbers on every machine and in every version.
pub fn stream(seed: u64, purpose: Purpose, index: u64, incarnation: u64) -> Stream {
    let mut key = [0; 32];
    for (bytes, word) in key.chunks_exact_mut(8).zip([seed, purpose as u64, index, incarnation]) {
        bytes.copy_from_slice(&word.to_le_bytes());
    }
    Stream::from_seed(key)
}

/// Moves to the beginning of the `number`-th of the 2⁶⁴ parts of a stream, for example the part of a step or an update.
pub fn seek(stream: &mut Stream, number: u64) -> &mut Stream {
    stream.set_stream(number);
    stream.set_word_pos(0);
    stream
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::Rng;

    #[test]
    fn every_word_of_the_name_changes_the_stream() {
        let first = |seed, purpose, index, incarnation| stream(seed, purpose, index, incarnation).next_u64();
        let base = first(1, Purpose::Exploration, 2, 3);
        assert_eq!(base, first(1, Purpose::Exploration, 2, 3));
        assert_ne!(base, first(2, Purpose::Exploration, 2, 3));
        assert_ne!(base, first(1, Purpose::Environment, 2, 3));
        assert_ne!(base, first(1, Purpose::Exploration, 3, 3));
        assert_ne!(base, first(1, Purpose::Exploration, 2, 4));
    }
}
