//! The running mean and variance of each number of an observation (Welford's method).

use std::ops::Range;

use shoal_common::network::normalise;

use super::algorithm::{StateArray, StateArrayMut};
use super::minibatch::Minibatch;
use crate::replay::Replay;

/// Added to a variance before its root is taken.
const VARIANCE_FLOOR: f64 = 1e-8;

/// Adapts a saved state to a new replay that begins with the rows `copied` of the state's own replay: the number of
/// rows looked at becomes the number of copied rows that were looked at.
pub(super) fn begin_with_rows(state: &mut [f32], copied: Range<u64>) {
    let [first, second, ..] = state else { return };
    let looked_at: f64 = bytemuck::cast([*first, *second]);
    let of_copied = (looked_at as u64).clamp(copied.start, copied.end) - copied.start;
    [*first, *second] = bytemuck::cast(of_copied as f64);
}

/// Mean and variance of the observations in the rows of a replay. Each row is counted at most once: the state has the
/// number of rows looked at so far.
#[derive(Clone, Debug)]
pub(super) struct Normaliser {
    width: usize,
    /// The number of rows looked at; the number of observations counted; the means; the sums of squared deviations.
    /// Both numbers of rows are exact up to 2⁵³.
    numbers: Vec<f64>,
    /// What a policy publishes: the means, then 1/√variance of each.
    published: Vec<f32>,
}

impl Normaliser {
    /// The name of its numbers in a checkpoint.
    pub(super) const ARRAY: &'static str = "observations";

    /// `f32`s in a checkpoint, for observations of this width.
    pub(super) fn state_numbers(width: usize) -> usize {
        2 * (2 + 2 * width)
    }

    /// The statistics before the first observation, for observations of `width` numbers. With them, observations are
    /// only clipped.
    pub(super) fn new(width: usize) -> Self {
        let mut new = Self {
            width,
            numbers: vec![0.0; 2 + 2 * width],
            published: vec![0.0; 2 * width],
        };
        new.publish();
        new
    }

    /// Counts the observations of the rows before `rows` that were not counted yet. Rows that the replay no longer has,
    /// or that are not finite, are left out.
    pub(super) fn count(&mut self, replay: &Replay, rows: u64) {
        let first = (self.numbers[0] as u64).max(replay.rows().start);
        self.count_rows(replay, first..rows);
        self.numbers[0] = rows.max(first) as f64;
        self.publish();
    }

    fn count_rows(&mut self, replay: &Replay, rows: Range<u64>) {
        let layout = replay.layout().row;
        let [_, counted, rest @ ..] = self.numbers.as_mut_slice() else {
            return;
        };
        let (means, squares) = rest.split_at_mut(self.width);
        for row in rows {
            let s = layout.read(replay.row(row)).s;
            if !s.iter().all(|x| x.is_finite()) {
                continue;
            }
            *counted += 1.0;
            for ((x, mean), square) in s.iter().zip(&mut *means).zip(&mut *squares) {
                let x = f64::from(*x);
                let before = x - *mean;
                *mean += before / *counted;
                *square += before * (x - *mean);
            }
        }
    }

    fn publish(&mut self) {
        let (counted, rest) = (self.numbers[1], &self.numbers[2..]);
        let (means, squares) = rest.split_at(self.width);
        let (mean, factor) = self.published.split_at_mut(self.width);
        for (((mean, factor), of_all), square) in mean.iter_mut().zip(factor).zip(means).zip(squares) {
            *mean = *of_all as f32;
            *factor = if counted < 2.0 {
                1.0
            } else {
                (1.0 / (square / counted + VARIANCE_FLOOR).sqrt()) as f32
            };
        }
    }

    /// What follows the layers in the parameters of a policy that normalises its observations.
    pub(super) fn published(&self) -> &[f32] {
        &self.published
    }

    /// Normalises the observations of a minibatch.
    pub(super) fn apply(&self, batch: &mut Minibatch) {
        let normalisation = self.published.split_at(self.width);
        normalise(batch.s.as_mut_slice(), normalisation);
        normalise(batch.s_next.as_mut_slice(), normalisation);
    }

    /// Its numbers, each `f64` as the two halves of its bits.
    pub(super) fn state(&self) -> StateArray<'_> {
        (Normaliser::ARRAY, bytemuck::cast_slice(&self.numbers))
    }

    /// As [`state`](Self::state), to be overwritten; [`restored`](Self::restored) must follow.
    pub(super) fn state_mut(&mut self) -> StateArrayMut<'_> {
        (Normaliser::ARRAY, bytemuck::cast_slice_mut(&mut self.numbers))
    }

    /// Derives the rest from a restored state.
    pub(super) fn restored(&mut self) {
        self.publish();
    }
}

#[cfg(test)]
mod tests {
    use rand::RngExt;
    use shoal_common::network::OBSERVATION_CLIP;
    use shoal_common::stream::{Purpose, stream};
    use shoal_common::transition::{RowLayout, Transition};

    use super::*;
    use crate::replay::{ChunkId, ReplayLayout};

    const WIDTH: usize = 2;

    /// A replay of `rows` random observations around (100, −3), and those observations.
    fn filled(rows: usize, ring: u64) -> (tempfile::TempDir, Replay, Vec<[f32; WIDTH]>) {
        let directory = tempfile::tempdir().unwrap();
        let row = RowLayout::new(WIDTH, 1);
        let layout = ReplayLayout {
            row,
            ring,
            actors: 1,
            actor_snapshot_words: 0,
            fingerprint: 0,
        };
        let mut replay = Replay::create(&directory.path().join("replay"), &layout).unwrap();
        let mut random = stream(1, Purpose::Environment, 0, 0);
        let mut observations = Vec::new();
        for sequence in 1..=rows as u64 {
            let s = [100.0 + random.random::<f32>(), -3.0 + 4.0 * random.random::<f32>()];
            let mut numbers = vec![0.0; row.width()];
            row.write(
                &Transition {
                    s: &s,
                    a: &[0.0],
                    r: 0.0,
                    discount: 1.0,
                    s_next: &s,
                    last: false,
                },
                &mut numbers,
            );
            let id = ChunkId {
                incarnation: 0,
                sequence,
            };
            replay.append_and_commit(0, id, &numbers).unwrap();
            observations.push(s);
        }
        (directory, replay, observations)
    }

    fn by_definition(observations: &[[f32; WIDTH]], element: usize) -> (f64, f64) {
        let numbers = || observations.iter().map(|s| f64::from(s[element]));
        let n = observations.len() as f64;
        let mean = numbers().sum::<f64>() / n;
        (mean, numbers().map(|x| (x - mean).powi(2)).sum::<f64>() / n)
    }

    #[test]
    fn mean_and_variance_are_those_of_all_rows_however_they_are_counted() {
        let (_directory, replay, observations) = filled(500, 1_000);
        let mut at_once = Normaliser::new(WIDTH);
        at_once.count(&replay, 500);
        let mut in_parts = Normaliser::new(WIDTH);
        for rows in [3, 3, 120, 499, 500] {
            in_parts.count(&replay, rows);
            // As after the death of a process.
            let mut successor = Normaliser::new(WIDTH);
            successor.state_mut().1.copy_from_slice(in_parts.state().1);
            successor.restored();
            assert_eq!(successor.published(), in_parts.published());
            in_parts = successor;
        }
        assert_eq!(at_once.numbers, in_parts.numbers);
        assert_eq!(at_once.state().1.len(), Normaliser::state_numbers(WIDTH));
        for element in 0..WIDTH {
            let (mean, variance) = by_definition(&observations, element);
            let (found, factor) = (at_once.published[element], at_once.published[WIDTH + element]);
            assert!((f64::from(found) - mean).abs() < 1e-5 * mean.abs());
            assert!((f64::from(factor) * variance.sqrt() - 1.0).abs() < 1e-5);
        }
    }

    #[test]
    fn rows_that_the_ring_lost_are_left_out() {
        let (_directory, replay, observations) = filled(500, 100);
        let mut normaliser = Normaliser::new(WIDTH);
        normaliser.count(&replay, 500);
        let (mean, _) = by_definition(&observations[400..], 1);
        assert!((f64::from(normaliser.published[1]) - mean).abs() < 1e-5);
    }

    #[test]
    fn a_minibatch_is_normalised_and_before_the_first_row_only_clipped() {
        let (_directory, replay, _) = filled(500, 1_000);
        let mut batch = Minibatch::new(RowLayout::new(WIDTH, 1), 500);
        batch.gather(&replay, &(0..500).collect::<Vec<_>>(), &replay.rows());
        let before = batch.clone();
        let mut normaliser = Normaliser::new(WIDTH);
        normaliser.apply(&mut batch);
        assert_eq!(batch.s.row(1), before.s.row(1));
        assert!(
            batch.s.row(0).iter().all(|x| *x == OBSERVATION_CLIP),
            "all are near 100"
        );
        batch = before.clone();
        normaliser.count(&replay, 500);
        normaliser.apply(&mut batch);
        for row in batch.s.row_iter() {
            let mean = row.iter().sum::<f32>() / 500.0;
            let variance = row.iter().map(|x| (x - mean).powi(2)).sum::<f32>() / 500.0;
            assert!(mean.abs() < 1e-3 && (variance - 1.0).abs() < 1e-3, "{mean}, {variance}");
        }
        assert_eq!(batch.s, batch.s_next);
        assert_eq!((batch.r, batch.a), (before.r, before.a));
    }
}
