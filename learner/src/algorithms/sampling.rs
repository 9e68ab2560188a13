//! The rows of a minibatch. They are a function of the run's seed and the update's number, so that an update that is
//! repeated after a crash takes the same rows.

use std::ops::Range;

use rand::Rng;
use shoal_common::stream::{Purpose, Stream, seek, stream};

/// Draws minibatches.
#[derive(Clone, Debug)]
pub struct Sampler {
    /// Part `u` of this stream has the row numbers of update number `u`.
    stream: Stream,
}

impl Sampler {
    /// The sampler of a run.
    pub fn new(seed: u64) -> Self {
        Self {
            stream: stream(seed, Purpose::Sampling, 0, 0),
        }
    }

    /// Fills `out` with rows of `range`, each uniform and independent of the others, for update number `update`.
    ///
    /// Element k comes from 64-bit number k of the update's stream by multiply and shift. Two of the `n` rows of a
    /// range differ in probability by at most 2⁻⁶⁴, a bias that no run is long enough to show. Rejection sampling
    /// would avoid it, but then a number's position in the stream would depend on the range.
    ///
    /// # Panics
    /// If the range is empty.
    pub fn indices(&self, update: u64, range: Range<u64>, out: &mut [u64]) {
        assert!(!range.is_empty(), "cannot draw a minibatch from an empty range");
        let rows = range.end - range.start;
        let mut numbers = self.stream.clone();
        seek(&mut numbers, update);
        for index in out {
            let scaled = u128::from(numbers.next_u64()) * u128::from(rows);
            *index = range.start + (scaled >> 64) as u64;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn draw(seed: u64, update: u64, range: Range<u64>) -> Vec<u64> {
        let mut out = vec![0; 64];
        Sampler::new(seed).indices(update, range, &mut out);
        out
    }

    #[test]
    fn a_repeated_update_takes_the_same_rows() {
        let sampler = Sampler::new(7);
        let mut first = [0; 64];
        let mut again = [0; 64];
        sampler.indices(12, 100..5000, &mut first);
        sampler.indices(13, 100..5000, &mut again);
        assert_ne!(first, again);
        sampler.indices(12, 100..5000, &mut again);
        assert_eq!(first, again);
        assert_ne!(draw(8, 12, 100..5000), first);
    }

    #[test]
    fn the_rows_are_the_same_on_every_machine_and_version() {
        assert_eq!(draw(1, 2, 1000..1_001_000)[..4], [949_753, 490_657, 400_442, 578_053]);
    }

    #[test]
    fn every_row_of_the_range_is_drawn_equally_often_and_no_other() {
        let mut counts = [0; 10];
        for update in 0..1000 {
            for index in draw(3, update, 90..100) {
                counts[(index - 90) as usize] += 1;
            }
        }
        // 64,000 draws into ten rows: standard deviation 76.
        assert!(counts.iter().all(|&n: &i32| (n - 6400).abs() < 400), "{counts:?}");
    }
}
