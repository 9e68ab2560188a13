//! The share of a core that an actor leaves to its policy. An actor and its environment server share one core, and
//! their rate is compared with the rate of the policy alone on this core. The two measurements alternate, so that a
//! disturbance affects both.

use std::time::{Duration, Instant};

use rustix::thread::sched_setaffinity;
use serde::Serialize;
use shoal_common::role::Role;

use super::cores::Cores;
use super::costs::Inference;
use super::intervals::{self, Samples};
use super::measurement::TimeBudget;
use super::processes::Processes;
use super::progress::RunProgress;
use super::rows::ENVIRONMENTS;
use super::temporary_run::{TemporaryRun, settings_for_counting};

/// Length of a turn of the actor and its server. A turn of the policy alone takes half as long.
const TURN_LENGTH: Duration = Duration::from_millis(200);

/// Target of the share.
pub(super) const TARGET: f64 = 0.8;

#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct OneCore {
    pub(super) pair_rows_per_second: f64,
    pub(super) inference_rows_per_second: f64,
    /// Median over turns of the first rate divided by the second.
    pub(super) share: f64,
    pub(super) share_least: f64,
    pub(super) share_greatest: f64,
    /// Whether the learner had another core.
    pub(super) learner_apart: bool,
}

/// Measures for about `length`.
pub(super) fn measure(length: Duration, budget: &TimeBudget) -> anyhow::Result<OneCore> {
    let temporary = TemporaryRun::of(1, ENVIRONMENTS as u32, &settings_for_counting(1, false))?;
    let mut inference = Inference::new(&temporary.config)?;
    let cores = Cores::choose()?;
    let cores_for = |role| {
        Some(match role {
            Role::Learner => cores.others,
            _ => cores.pair,
        })
    };
    temporary.with_processes(cores_for, |domain, processes| {
        let mut progress = RunProgress::begin(&temporary, domain, processes, budget)?;
        let turns = intervals::count(length, 1.0, TURN_LENGTH.mul_f64(1.5));
        let turn = TURN_LENGTH.min(length.div_f64(1.5));
        take_turns(&mut progress, processes, &cores, turns, turn, &mut inference, budget)
    })
}

fn take_turns(
    progress: &mut RunProgress<'_>,
    processes: &mut Processes,
    cores: &Cores,
    turns: usize,
    turn: Duration,
    inference: &mut Inference,
    budget: &TimeBudget,
) -> anyhow::Result<OneCore> {
    let (mut pair, mut alone, mut shares) = (Samples::default(), Samples::default(), Samples::default());
    for _ in 0..turns {
        sched_setaffinity(None, &cores.others)?;
        // The actor and its server have just been resumed.
        std::thread::sleep(turn / 10);
        let (begun, before) = (Instant::now(), progress.rows());
        progress.sleep(turn, processes, budget)?;
        let rows = (progress.rows() - before) as f64 / begun.elapsed().as_secs_f64();
        let rate = processes.with_actors_paused(|| -> anyhow::Result<f64> {
            sched_setaffinity(None, &cores.pair)?;
            inference.step();
            Ok(intervals::rate(turn / 2, || inference.step()))
        })??;
        pair.add(rows);
        alone.add(rate * ENVIRONMENTS as f64);
        shares.add(rows / (rate * ENVIRONMENTS as f64));
    }
    Ok(OneCore {
        pair_rows_per_second: pair.median(),
        inference_rows_per_second: alone.median(),
        share: shares.median(),
        share_least: shares.least(),
        share_greatest: shares.greatest(),
        learner_apart: cores.pair != cores.others,
    })
}
