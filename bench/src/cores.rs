//! The cores that processes are bound to.

use rustix::thread::{CpuSet, sched_getaffinity, sched_setaffinity};

/// One core for an actor and its server, and one for everything else; the same core if the machine has only one.
/// Dropping this lets the current process run on all of its cores again.
pub(super) struct Cores {
    pub(super) pair: CpuSet,
    pub(super) others: CpuSet,
    all: CpuSet,
}

impl Cores {
    pub(super) fn choose() -> anyhow::Result<Self> {
        let all = sched_getaffinity(None)?;
        let mut usable = (0..CpuSet::MAX_CPU).filter(|core| all.is_set(*core)).map(|core| {
            let mut set = CpuSet::new();
            set.set(core);
            set
        });
        // Interrupts often go to a machine's first core.
        let first = usable.next().unwrap_or(all);
        Ok(Self {
            pair: usable.next_back().unwrap_or(first),
            others: first,
            all,
        })
    }
}

impl Drop for Cores {
    fn drop(&mut self) {
        let _ = sched_setaffinity(None, &self.all);
    }
}
