//! Angles, in radians.

use std::f64::consts::{PI, TAU};

/// The same direction within [−π, π].
pub fn wrap(angle: f64) -> f64 {
    (angle + PI).rem_euclid(TAU) - PI
}

/// The same angles without jumps between them, beginning near `start`. Successive angles must differ by less than half
/// a turn.
pub fn unwrapped(angles: impl Iterator<Item = f64>, start: f64) -> Vec<f64> {
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
    fn wrapping_removes_whole_turns() {
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
