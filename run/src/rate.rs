//! Rates and the ratio of updates to environment steps, for the live line, the records and the status alike.

use std::time::Duration;

/// How much `now` counts above `before`, per second; each is a time and a count. `None` while no time has passed, and where the
/// count is lower, as after a restart from a checkpoint.
pub fn per_second((then, earlier): (Duration, u64), (now, count): (Duration, u64)) -> Option<f64> {
    let seconds = now.checked_sub(then)?.as_secs_f64();
    let made = count.checked_sub(earlier)?;
    (seconds > 0.0).then_some(made as f64 / seconds)
}

/// Updates for each environment step beyond the warm-up; `None` during the warm-up.
pub fn updates_per_step(updates: u64, env_steps: u64, warmup: u64) -> Option<f64> {
    let steps = env_steps.saturating_sub(warmup);
    (steps > 0).then(|| updates as f64 / steps as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_needs_time_and_a_count_that_rose() {
        let at = Duration::from_secs;
        assert_eq!(per_second((at(2), 100), (at(4), 150)), Some(25.0));
        assert_eq!(per_second((at(2), 100), (at(4), 100)), Some(0.0));
        assert_eq!(per_second((at(2), 100), (at(2), 150)), None);
        assert_eq!(per_second((at(2), 100), (at(4), 99)), None, "a restart");
        assert_eq!(per_second((at(4), 100), (at(2), 150)), None);
    }

    #[test]
    fn the_ratio_begins_after_the_warm_up() {
        assert_eq!(updates_per_step(0, 100, 100), None);
        assert_eq!(updates_per_step(0, 50, 100), None);
        assert_eq!(updates_per_step(30, 120, 100), Some(1.5));
    }
}
