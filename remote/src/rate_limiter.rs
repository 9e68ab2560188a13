//! A limit for a rate.

use std::time::{Duration, Instant};

/// A token bucket: tokens arrive at a constant rate, and at most those of half a second are kept.
#[derive(Clone, Copy, Debug)]
pub struct RateLimiter {
    rate: f64,
    available: f64,
    refilled_at: Instant,
}

const BURST: Duration = Duration::from_millis(500);

impl RateLimiter {
    /// A full bucket that gets `rate` tokens a second.
    pub fn new(rate: f64, now: Instant) -> Self {
        Self {
            rate,
            available: rate * BURST.as_secs_f64(),
            refilled_at: now,
        }
    }

    /// Takes `amount` tokens if any are there, and returns whether it did. The amount may exceed what is available. The
    /// balance then becomes negative, and the next amount waits longer.
    pub fn take(&mut self, amount: f64, now: Instant) -> bool {
        let refilled = self.available + self.rate * now.saturating_duration_since(self.refilled_at).as_secs_f64();
        self.available = refilled.min(self.rate * BURST.as_secs_f64());
        self.refilled_at = now;
        let may = self.available > 0.0;
        if may {
            self.available -= amount;
        }
        may
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn in_the_long_run_no_more_is_taken_than_the_rate_allows() {
        let begin = Instant::now();
        for amount in [1.0, 700.0, 30_000.0] {
            let mut limiter = RateLimiter::new(1000.0, begin);
            let times = (0..100_000).map(|i| begin + Duration::from_millis(i));
            let taken = times.filter(|now| limiter.take(amount, *now)).count() as f64 * amount;
            assert!(
                (100_000.0..=100_000.0 + 500.0 + amount).contains(&taken),
                "{taken} in pieces of {amount}"
            );
        }
    }
}
