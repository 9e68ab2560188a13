//! Test runs as the thesis shows them: what the numbers of a trajectory mean, and what there is to measure.

pub(crate) mod lake;
pub(crate) mod pendulum;
pub(crate) mod point_mass;

use std::f64::consts::{PI, TAU};

/// A behaviour at rest is measured over so many steps at an episode's end.
pub(crate) const AT_REST: usize = 50;

/// The same direction within [−π, π): how the environments take differences of angles.
fn wrap(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

/// The last `count` values, or all where there are fewer.
fn tail(values: &[f64], count: usize) -> &[f64] {
    &values[values.len().saturating_sub(count)..]
}

/// 0 where there are no values.
fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

/// To four significant digits: enough for a figure.
fn round(values: &mut [f64]) {
    for value in values {
        *value = format!("{value:.3e}").parse().unwrap_or(*value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_digits_are_kept() {
        let mut values = [2.345_67, -0.000_123_456, 0.0, 123_456.0];
        round(&mut values);
        assert_eq!(values, [2.346, -0.000_123_5, 0.0, 123_500.0]);
    }

    #[test]
    fn angles_differ_by_half_a_turn_at_most() {
        assert!((wrap(3.0 - -3.0) - (6.0 - TAU)).abs() < 1e-12);
        assert_eq!(wrap(0.5), 0.5);
    }
}
