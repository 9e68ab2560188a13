//! Measurement in short intervals, so that a disturbance affects some of them but not their median.

use std::time::{Duration, Instant};

/// Repeats `work` for about `length` and returns the number of calls per second.
pub(super) fn rate(length: Duration, mut work: impl FnMut()) -> f64 {
    // Reading the clock takes some 30 ns, so it is read about every 20 µs, or after every call that takes longer.
    let begun = Instant::now();
    work();
    let stride = (2e-5 / begun.elapsed().as_secs_f64().max(1e-9)).clamp(1.0, 1_000.0) as u32;
    let begun = Instant::now();
    let mut done = 0.0;
    loop {
        (0..stride).for_each(|_| work());
        done += f64::from(stride);
        let elapsed = begun.elapsed();
        if elapsed >= length {
            return done / elapsed.as_secs_f64();
        }
    }
}

/// Sorted samples. The median is the result; the extremes show how quiet the machine was.
#[derive(Clone, Debug, Default)]
pub(super) struct Samples(Vec<f64>);

impl Samples {
    pub(super) fn add(&mut self, value: f64) {
        let place = self.0.partition_point(|other| *other < value);
        self.0.insert(place, value);
    }

    pub(super) fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    #[cfg(feature = "remote")]
    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    /// Panics if there is no result.
    pub(super) fn median(&self) -> f64 {
        self.0[self.0.len() / 2]
    }

    pub(super) fn least(&self) -> f64 {
        self.0[0]
    }

    pub(super) fn greatest(&self) -> f64 {
        self.0[self.0.len() - 1]
    }

    /// Text for the user: the median, and the extremes in brackets, each divided by `unit`.
    pub(super) fn show(&self, unit: f64, decimals: usize) -> String {
        let [median, least, greatest] = [self.median(), self.least(), self.greatest()].map(|rate| rate / unit);
        format!("{median:.decimals$} ({least:.decimals$} to {greatest:.decimals$})")
    }
}

/// How many intervals of length `interval` fit into the `share` of `whole`; at least one.
pub(super) fn count(whole: Duration, share: f64, interval: Duration) -> usize {
    (whole.as_secs_f64() * share / interval.as_secs_f64()).round().max(1.0) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_counts_every_call() {
        let mut calls = 0.0;
        let begun = Instant::now();
        let rate = rate(Duration::from_millis(20), || calls += 1.0);
        assert!(rate <= calls / 0.02 && rate >= (calls - 1_001.0) / begun.elapsed().as_secs_f64());
    }

    #[test]
    fn the_median_is_the_middle_of_the_sorted_rates() {
        let mut results = Samples::default();
        [5.0, 1.0, 4.0, 2.0, 3.0].into_iter().for_each(|rate| results.add(rate));
        assert_eq!((results.least(), results.median(), results.greatest()), (1.0, 3.0, 5.0));
        assert_eq!(results.show(1.0, 1), "3.0 (1.0 to 5.0)");
    }
}
