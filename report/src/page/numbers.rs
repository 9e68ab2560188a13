//! Rounds and thins out the page's numbers, and limits how many there are.

use std::ops::Range;

/// Points in a curve of a single run. Several runs share a total, so that the page stays small.
pub(super) const POINTS: usize = 800;
const POINTS_TOGETHER: usize = 4_000;
const FEWEST_POINTS: usize = 60;

/// Playable episodes of a single run. Several runs share a total.
const EPISODES: usize = 6;
const EPISODES_TOGETHER: usize = 24;

/// Pictures of all runs whose environments other programs draw. Drawing takes time, and the page stays small.
const PICTURES_TOGETHER: usize = 300;
const PICTURES: usize = 150;
const FEWEST_PICTURES: usize = 25;
const BYTES_TOGETHER: usize = 6_000_000;

/// How much of one run the page may contain.
#[derive(Clone, Copy, Debug)]
pub(super) struct PageLimits {
    pub(super) points: usize,
    pub(super) episodes: usize,
    /// Playable episodes with pictures that another program draws.
    pub(super) pictured: usize,
    /// Pictures of such an episode.
    pub(super) pictures: usize,
    /// Bytes of all pictures of one such episode.
    pub(super) bytes: usize,
}

impl PageLimits {
    /// For what shows neither curves nor episodes.
    pub(super) const NONE: Self = Self {
        points: FEWEST_POINTS,
        episodes: 0,
        pictured: 0,
        pictures: 0,
        bytes: 0,
    };

    /// For run `number`, counted from 0, of `runs` in the report.
    pub(super) fn of(number: usize, runs: usize) -> Self {
        let pictured = match runs {
            1 => 2,
            _ => usize::from(number < PICTURES_TOGETHER / FEWEST_PICTURES),
        };
        let shown = runs.min(PICTURES_TOGETHER / FEWEST_PICTURES) * pictured.max(1);
        Self {
            points: (POINTS_TOGETHER / runs).clamp(FEWEST_POINTS, POINTS),
            episodes: match EPISODES_TOGETHER / runs {
                0 => usize::from(number < EPISODES_TOGETHER),
                share => share.min(EPISODES),
            },
            pictured,
            pictures: (PICTURES_TOGETHER / shown).min(PICTURES),
            bytes: BYTES_TOGETHER / shown,
        }
    }
}

/// Rounds to five significant digits, which is finer than any screen.
pub(super) fn short(value: f64) -> f64 {
    format!("{value:.4e}").parse().unwrap_or(value)
}

/// Divides `0..len` into at most `most` consecutive parts of about equal length.
pub(super) fn parts(len: usize, most: usize) -> impl Iterator<Item = Range<usize>> {
    let count = len.min(most.max(1));
    (0..count).map(move |i| i * len / count..(i + 1) * len / count)
}

/// The mean of the finite values; NaN if there are none.
pub(super) fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for value in values.filter(|value| value.is_finite()) {
        sum += value;
        count += 1;
    }
    short(sum / f64::from(count))
}

/// Indices of at most `most` values (but at least four), in ascending order: the first, the last, and the minimum and
/// maximum of each part. Peaks are therefore kept.
pub(super) fn downsample(values: &[f64], most: usize) -> Vec<usize> {
    if values.len() <= most {
        return (0..values.len()).collect();
    }
    let last = values.len() - 1;
    let mut indices = vec![0, last];
    for part in parts(values.len(), (most / 2).max(2) - 1) {
        let by_value = |a: &usize, b: &usize| values[*a].total_cmp(&values[*b]);
        indices.extend(part.clone().min_by(by_value));
        indices.extend(part.max_by(by_value));
    }
    indices.sort_unstable();
    indices.dedup();
    indices
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn numbers_are_rounded_to_five_digits() {
        assert_eq!(
            [2.345_678_9, -0.000_123_456_78, 0.0, 1_234_567.0].map(short),
            [2.345_7, -0.000_123_46, 0.0, 1_234_600.0]
        );
        assert!(short(f64::NAN).is_nan());
        assert_eq!(mean([1.0, f64::NAN, 3.0].into_iter()), 2.0);
        assert!(mean(std::iter::empty()).is_nan());
    }

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn downsampling_keeps_ends_and_peaks_and_repeats_nothing(
            values in prop::collection::vec(-1e9..1e9_f64, 1..300),
            most in 4..100_usize,
        ) {
            let indices = downsample(&values, most);
            prop_assert!(indices.len() <= most.max(values.len().min(most)), "{} of {most}", indices.len());
            prop_assert!(indices.windows(2).all(|pair| pair[0] < pair[1]));
            prop_assert_eq!((indices[0], indices[indices.len() - 1]), (0, values.len() - 1));
            let greatest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            prop_assert!(indices.iter().any(|i| values[*i] == greatest));
        }

        #[test]
        fn parts_cover_everything_once(len in 0..1000_usize, most in 1..50_usize) {
            let parts: Vec<_> = parts(len, most).collect();
            prop_assert!(parts.len() <= most);
            prop_assert!(parts.iter().all(|part| !part.is_empty()));
            prop_assert_eq!(parts.into_iter().flatten().collect::<Vec<_>>(), (0..len).collect::<Vec<_>>());
        }
    }
}
