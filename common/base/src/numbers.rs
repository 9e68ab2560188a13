//! Sums and checks of slices of numbers, and the limit of counters.

/// The upper limit of every counter of a run: rows, updates, episodes, versions, records, processes. Sums of a few
/// counters below it fit into a `u64`.
pub const COUNTER_LIMIT: u64 = 1 << 60;

/// Mean and sample standard deviation; the latter is 0 for fewer than two numbers.
pub fn mean_and_std(numbers: &[f64]) -> (f64, f64) {
    let n = numbers.len() as f64;
    let mean = numbers.iter().sum::<f64>() / n;
    if numbers.len() < 2 {
        return (mean, 0.0);
    }
    let squares: f64 = numbers.iter().map(|number| (number - mean).powi(2)).sum();
    (mean, (squares / (n - 1.0)).sqrt())
}

/// Whether all these numbers are finite. It reads all of them even after one that is not: without an early exit, the
/// compiler can use vector instructions.
#[inline]
pub fn are_finite(numbers: &[f32]) -> bool {
    numbers.iter().fold(true, |all, number| all & number.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deviation_is_that_of_a_sample() {
        assert_eq!(mean_and_std(&[1.0, 3.0]), (2.0, 2.0_f64.sqrt()));
        assert_eq!(mean_and_std(&[5.0]), (5.0, 0.0));
        assert!(mean_and_std(&[]).0.is_nan());
    }

    #[test]
    fn one_number_that_is_not_finite_is_found_anywhere() {
        assert!(are_finite(&[]) && are_finite(&[f32::MAX, -0.0]));
        for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
            assert!(!are_finite(&[wrong, 0.0]) && !are_finite(&[0.0, wrong]));
        }
    }
}
