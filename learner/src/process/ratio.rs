//! Updates per environment step, kept from both sides.

use shoal_common::config;

/// How many updates the rows collected so far allow.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ratio {
    /// Rows before the first update.
    pub warmup: u64,
    /// Updates for each row beyond the warm-up.
    pub updates_per_step: f64,
    /// Rows by which the actors may be ahead.
    pub tolerance: u64,
}

impl From<&config::ReplayConfig> for Ratio {
    fn from(replay: &config::ReplayConfig) -> Self {
        Self {
            warmup: replay.warmup,
            updates_per_step: replay.updates_per_step,
            tolerance: replay.tolerance,
        }
    }
}

impl Ratio {
    /// Updates that may have been done when the replay has seen `rows` rows.
    pub fn allowed(&self, rows: u64) -> u64 {
        (rows.saturating_sub(self.warmup) as f64 * self.updates_per_step) as u64
    }

    /// Whether so many more rows are waiting for their updates that the learner should take no further ones.
    pub fn is_behind(&self, rows: u64, updates: u64) -> bool {
        rows.saturating_sub(self.tolerance) > self.warmup && self.allowed(rows - self.tolerance) > updates
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neither_side_gets_further_ahead_than_agreed() {
        let ratio = Ratio {
            warmup: 100,
            updates_per_step: 0.5,
            tolerance: 10,
        };
        assert_eq!((ratio.allowed(100), ratio.allowed(101), ratio.allowed(102)), (0, 0, 1));
        assert!(!ratio.is_behind(111, 0), "the tolerance is not used up");
        assert!(ratio.is_behind(112, 0));
        assert!(!ratio.is_behind(112, 1));
        assert!(!ratio.is_behind(5, 0));
    }
}
