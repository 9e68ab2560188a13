//! The quantities that the thesis measures in episodes of its environments.

pub mod lake;
pub mod pendulum;
pub mod point_mass;

/// Number of steps at the end of an episode over which the behaviour at rest is measured.
pub const AT_REST: usize = 50;

/// The last `count` values, or all of them if there are fewer.
fn tail(values: &[f64], count: usize) -> &[f64] {
    &values[values.len().saturating_sub(count)..]
}

/// The mean; 0 if there are no values.
fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// Rounds to four significant digits, enough for a figure.
fn round(values: &mut [f64]) {
    for value in values {
        *value = format!("{value:.3e}").parse().unwrap_or(*value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_significant_digits_are_kept() {
        let mut values = [2.345_67, -0.000_123_456, 0.0, 123_456.0];
        round(&mut values);
        assert_eq!(values, [2.346, -0.000_123_5, 0.0, 123_500.0]);
    }
}
