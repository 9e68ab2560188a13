//! Rates, for the live line, the records and the status.

use std::time::Duration;

/// The increase per second from the first time and count to the second. `None` if no time has passed, or if the count
/// has fallen, as after a restart from a checkpoint.
pub fn per_second((then, earlier): (Duration, u64), (now, count): (Duration, u64)) -> Option<f64> {
    let seconds = now.checked_sub(then)?.as_secs_f64();
    let made = count.checked_sub(earlier)?;
    (seconds > 0.0).then_some(made as f64 / seconds)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_needs_elapsed_time_and_a_count_that_did_not_fall() {
        let at = Duration::from_secs;
        assert_eq!(per_second((at(2), 100), (at(4), 150)), Some(25.0));
        assert_eq!(per_second((at(2), 100), (at(4), 100)), Some(0.0));
        assert_eq!(per_second((at(2), 100), (at(2), 150)), None);
        assert_eq!(per_second((at(2), 100), (at(4), 99)), None, "a restart");
        assert_eq!(per_second((at(4), 100), (at(2), 150)), None);
    }
}
