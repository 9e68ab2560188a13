//! The ratio of updates to environment steps. Neither the learner nor the actors may get ahead of it.

use shoal_common::config;

/// How many updates the environment steps collected so far allow. An update is a gradient step or, for methods that use
/// each row once, a row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ratio {
    /// Environment steps before the first update.
    pub warmup: u64,
    /// Updates for each environment step after the warm-up.
    pub updates_per_step: f64,
    /// Environment steps by which the actors may be ahead.
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
    /// How many updates are allowed in total after `rows` environment steps.
    pub fn allowed(&self, rows: u64) -> u64 {
        (rows.saturating_sub(self.warmup) as f64 * self.updates_per_step) as u64
    }

    /// Whether the learner is behind by more than the tolerance, so that it should take no more rows.
    pub fn is_behind(&self, rows: u64, updates: u64) -> bool {
        rows.saturating_sub(self.tolerance) > self.warmup && self.allowed(rows - self.tolerance) > updates
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neither_side_gets_ahead_by_more_than_the_tolerance() {
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
