//! Angles, in radians.

use std::f64::consts::{PI, TAU};

/// The same direction within [−π, π].
pub fn wrap(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

/// The same angles without jumps, as they follow one another from `start` on. It turns by less than half a turn a step.
pub fn followed(angles: impl Iterator<Item = f64>, start: f64) -> Vec<f64> {
    angles
        .scan(start, |angle, seen| {
            *angle += wrap(seen - *angle);
            Some(*angle)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn whole_turns_vanish() {
        for (angle, wrapped) in [
            (0.5, 0.5),
            (PI + 0.1, 0.1 - PI),
            (-PI - 0.1, PI - 0.1),
            (7.0 * TAU - 2.0, -2.0),
        ] {
            assert!((wrap(angle) - wrapped).abs() < 1e-12, "{angle}");
        }
    }
}
