//! The ratio of updates to environment steps. Neither the learner nor the actors may get ahead of it.

use shoal_common::config;

/// How many updates the environment steps collected so far allow. An update is a gradient step or, for algorithms that
/// use each row once, a row.
#[derive(Clone, Debug, PartialEq)]
pub struct Ratio(config::ReplayConfig);

impl From<&config::ReplayConfig> for Ratio {
    fn from(replay: &config::ReplayConfig) -> Self {
        Self(replay.clone())
    }
}

impl Ratio {
    /// How many updates are allowed in total after `rows` environment steps.
    pub fn allowed(&self, rows: u64) -> u64 {
        self.0.agreed_updates(rows)
    }

    /// Whether the learner is behind by more than the tolerance, so that it should take no more rows.
    pub fn is_behind(&self, rows: u64, updates: u64) -> bool {
        let rows = rows.saturating_sub(self.0.tolerance);
        rows > self.0.ratio_start() && self.allowed(rows) > updates
    }

    /// The environment step after which the ratio counts.
    pub fn start(&self) -> u64 {
        self.0.ratio_start()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn neither_side_gets_ahead_by_more_than_the_tolerance() {
        let ratio = Ratio(config::ReplayConfig {
            warmup: 100,
            updates_per_step: 0.5,
            tolerance: 10,
            ..config::ReplayConfig::default()
        });
        assert_eq!((ratio.allowed(100), ratio.allowed(101), ratio.allowed(102)), (0, 0, 1));
        assert!(!ratio.is_behind(111, 0), "the tolerance is not used up");
        assert!(ratio.is_behind(112, 0));
        assert!(!ratio.is_behind(112, 1));
        assert!(!ratio.is_behind(5, 0));
    }
}
