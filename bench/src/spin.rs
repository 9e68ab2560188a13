//! The limit of a round trip: two threads that spin on a word in memory, waiting for each other.

use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// A word on two cache lines of its own, because lines are fetched in pairs.
#[repr(align(128))]
struct Word(AtomicU64);

impl Word {
    fn wait_while(&self, value: u64) -> u64 {
        loop {
            let found = self.0.load(Ordering::Acquire);
            if found != value {
                return found;
            }
            std::hint::spin_loop();
        }
    }
}

const END: u64 = u64::MAX;

/// Times of round trips, in ns; at least one.
pub(super) fn times(length: Duration) -> Vec<u32> {
    let (there, back) = (Word(AtomicU64::new(0)), Word(AtomicU64::new(0)));
    std::thread::scope(|scope| {
        scope.spawn(|| {
            let mut last = 0;
            while last != END {
                last = there.wait_while(last);
                back.0.store(last, Ordering::Release);
            }
        });
        let begun = Instant::now();
        let mut times = Vec::new();
        for number in 1.. {
            let before = Instant::now();
            there.0.store(number, Ordering::Release);
            back.wait_while(number - 1);
            let after = Instant::now();
            times.push((after - before).as_nanos().try_into().unwrap_or(u32::MAX));
            if after - begun >= length {
                break;
            }
        }
        there.0.store(END, Ordering::Release);
        times
    })
}
