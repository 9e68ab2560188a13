//! Freeing shared memory that dead processes occupy: when it is due, and whether it helps.

use std::time::{Duration, Instant};

use shoal_common::channel::{Domain, Services};

use crate::launcher::cleaner;
use crate::launcher::log::Log;

/// How often to look for dead processes whose end the launcher does not observe, such as `shoal status`.
const CLEANUP_INTERVAL: Duration = Duration::from_secs(2);

/// How long dead processes may keep occupying shared memory in spite of clean-ups. A killed process may take a moment
/// to disappear.
const OCCUPIED_TIMEOUT: Duration = Duration::from_secs(2);

/// How long dead processes may occupy shared memory while the clean-ups themselves fail.
const FAILING_TIMEOUT: Duration = Duration::from_secs(20);

/// The pause between clean-ups while dead processes occupy shared memory.
const OCCUPIED_CLEANUP_INTERVAL: Duration = Duration::from_millis(200);

/// The clean-ups of a run's shared memory.
#[derive(Debug)]
pub(super) struct Cleaning {
    cleaned_at: Instant,
    /// Since when dead processes have occupied shared memory in spite of clean-ups.
    occupied_since: Option<Instant>,
    /// Time spent on clean-ups since the last [`take_time`](Self::take_time).
    time: Duration,
}

impl Cleaning {
    pub(super) fn new() -> Self {
        Self {
            cleaned_at: Instant::now(),
            occupied_since: None,
            time: Duration::ZERO,
        }
    }

    /// The time until the next clean-up, unless a process ends earlier.
    pub(super) fn time_to_next(&self) -> Duration {
        let interval = self
            .occupied_since
            .map_or(CLEANUP_INTERVAL, |_| OCCUPIED_CLEANUP_INTERVAL);
        interval.saturating_sub(self.cleaned_at.elapsed())
    }

    pub(super) fn is_due(&self) -> bool {
        self.time_to_next().is_zero()
    }

    /// Cleans up if dead processes have left anything. Returns whether the memory can be freed.
    pub(super) fn clean_if_needed(&mut self, domain: &Domain, services: &Services, log: &Log) -> bool {
        self.cleaned_at = Instant::now();
        let is_needed = domain.has_dead_nodes() || services.ports_of_dead_processes() > 0;
        !is_needed || self.clean(domain, services, log)
    }

    /// Frees shared memory that dead processes occupy. Returns whether it can be freed.
    pub(super) fn clean(&mut self, domain: &Domain, services: &Services, log: &Log) -> bool {
        let begun = Instant::now();
        let cleaned = cleaner::clean_up(domain, services);
        self.cleaned_at = Instant::now();
        self.time += begun.elapsed();
        if let Err(error) = &cleaned {
            log.note("launcher", &format!("{error:#}"));
        }
        if services.ports_of_dead_processes() == 0 {
            self.occupied_since = None;
            return true;
        }
        let since = *self.occupied_since.get_or_insert(begun);
        let timeout = if cleaned.is_ok() {
            OCCUPIED_TIMEOUT
        } else {
            FAILING_TIMEOUT
        };
        since.elapsed() < timeout
    }

    /// The time spent on clean-ups since the last call.
    pub(super) fn take_time(&mut self) -> Duration {
        std::mem::take(&mut self.time)
    }
}
