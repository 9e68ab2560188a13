//! A complete training run with its launcher: the time to its first gradient steps, the time to replace a killed
//! learner, and the memory of its processes.

use std::time::{Duration, Instant};

use anyhow::Context;
use rustix::process::{Pid, Signal, kill_process};
use serde::Serialize;
use shoal_common::role::Role;

use self::training::{Recovery, Startup, Training};
use super::intervals::Samples;
use super::measurement::{StageResults, TimeBudget};
use super::memory::Memory;
use super::target::{Target, TargetRow};

mod training;

/// Share of the time for starting runs. In the rest, the learner of the last run is killed repeatedly.
const STARTUP_SHARE: f64 = 0.4;

/// Limit on the number of starts and on the number of kills.
const MAX_REPEATS: usize = 20;

/// Targets: the time of a start and of a recovery in seconds, and the private memory of a process in bytes.
const TARGET_SECONDS: f64 = 0.5;
const TARGET_BYTES: u64 = 64_000_000;

const MEGABYTE: f64 = 1e6;

/// The fields of `bench run --json`. Times are in seconds.
#[derive(Serialize)]
pub(super) struct RunResults {
    starts: usize,
    /// From the launcher's start to the first heartbeat of every role.
    ready_seconds: Spread,
    /// From the first row committed to the last row of the warm-up.
    warm_up_seconds: Spread,
    warm_up_rows: u64,
    /// From the last row of the warm-up to the first policy that gradient steps have changed.
    first_update_seconds: Spread,
    /// From the launcher's start to that policy, minus the warm-up.
    start_seconds: Spread,
    kills: usize,
    /// From the learner's `kill -9` to its successor's first heartbeat.
    successor_ready_seconds: Spread,
    /// From the learner's `kill -9` to its successor's first policy that gradient steps have changed.
    recovery_seconds: Spread,
    target_seconds: f64,
    roles: Vec<RoleMemory>,
    target_private_bytes: u64,
}

#[derive(Serialize)]
struct Spread {
    median: f64,
    worst: f64,
}

#[derive(Serialize)]
struct RoleMemory {
    role: &'static str,
    index: u32,
    #[serde(flatten)]
    memory: Memory,
}

pub(super) fn measure(budget: &TimeBudget) -> anyhow::Result<RunResults> {
    let begun = Instant::now();
    let mut starts = Vec::new();
    loop {
        let mut training = Training::start()?;
        let measured = training.begin(budget).and_then(|began| {
            starts.push(began);
            let is_last = begun.elapsed() >= budget.length.mul_f64(STARTUP_SHARE) || starts.len() >= MAX_REPEATS;
            is_last
                .then(|| recoveries_and_memory(&mut training, begun, budget))
                .transpose()
        });
        let ended = training.end();
        let measured = measured?;
        ended?;
        if let Some((recoveries, roles)) = measured {
            return Ok(RunResults::new(&starts, &recoveries, roles));
        }
    }
}

/// Measures the memory of each process, then kills the learner until the time is over, at least once.
fn recoveries_and_memory(
    training: &mut Training,
    begun: Instant,
    budget: &TimeBudget,
) -> anyhow::Result<(Vec<Recovery>, Vec<RoleMemory>)> {
    let mut recoveries = Vec::new();
    let mut roles = Vec::new();
    while recoveries.is_empty() || (begun.elapsed() < budget.length && recoveries.len() < MAX_REPEATS) {
        training.settle(budget)?;
        let processes = training.processes()?;
        if recoveries.is_empty() {
            for (role, index, pid) in &processes {
                roles.push(RoleMemory {
                    role: role.name(),
                    index: *index,
                    memory: Memory::of(*pid, &training.replay()?)?,
                });
            }
        }
        let learner = processes.iter().find(|(role, ..)| *role == Role::Learner);
        let pid = learner.and_then(|(.., pid)| Pid::from_raw(*pid as i32));
        let pid = pid.context("the run has no learner to kill")?;
        let killed = Instant::now();
        kill_process(pid, Signal::KILL).context("cannot kill the learner")?;
        recoveries.push(training.recover(killed, budget)?);
    }
    Ok((recoveries, roles))
}

impl RunResults {
    fn new(starts: &[Startup], recoveries: &[Recovery], roles: Vec<RoleMemory>) -> Self {
        let of_starts = |seconds: fn(&Startup) -> Duration| Spread::of(starts.iter().map(seconds));
        Self {
            starts: starts.len(),
            ready_seconds: of_starts(|began| began.ready),
            warm_up_seconds: of_starts(Startup::warm_up),
            warm_up_rows: starts.first().map_or(0, |began| began.warm_up_rows),
            first_update_seconds: of_starts(|began| began.update.saturating_sub(began.warm)),
            start_seconds: of_starts(|began| began.update - began.warm_up()),
            kills: recoveries.len(),
            successor_ready_seconds: Spread::of(recoveries.iter().map(|came| came.ready)),
            recovery_seconds: Spread::of(recoveries.iter().map(|came| came.update)),
            target_seconds: TARGET_SECONDS,
            roles,
            target_private_bytes: TARGET_BYTES,
        }
    }
}

impl Spread {
    /// Panics if there are no times.
    fn of(times: impl Iterator<Item = Duration>) -> Self {
        let mut results = Samples::default();
        times.for_each(|time| results.add(time.as_secs_f64()));
        Self {
            median: results.median(),
            worst: results.greatest(),
        }
    }

    fn show(&self) -> String {
        format!("{:.3} s, at worst {:.3}", self.median, self.worst)
    }
}

impl StageResults for RunResults {
    fn target_rows(&self) -> Vec<TargetRow> {
        let seconds = |stage, spread: &Spread| TargetRow {
            stage,
            ours: spread.show(),
            limit: String::new(),
            share: None,
            target: Target::at_most(TARGET_SECONDS, spread.worst, "0.5 s"),
        };
        let most = self
            .roles
            .iter()
            .map(|role| role.memory.private_bytes)
            .max()
            .unwrap_or(0);
        vec![
            seconds("start to first update", &self.start_seconds),
            seconds("killed learner to next update", &self.recovery_seconds),
            TargetRow {
                stage: "memory of the largest role",
                ours: format!("{:.1} MB", most as f64 / MEGABYTE),
                limit: String::new(),
                share: None,
                target: Target::at_most(TARGET_BYTES as f64, most as f64, "64 MB"),
            },
        ]
    }

    fn entries(&self) -> Vec<(&'static str, String)> {
        let roles = self.roles.iter().map(|RoleMemory { role, index, memory }| {
            let megabytes = |bytes: u64| bytes as f64 / MEGABYTE;
            format!(
                "{role} {index}: {:.1} MB private, {:.1} proportional; shared memory {:.1}, files {:.1}, replay {:.1}",
                megabytes(memory.private_bytes),
                megabytes(memory.proportional_bytes),
                megabytes(memory.shared_memory_bytes),
                megabytes(memory.file_bytes),
                megabytes(memory.replay_bytes)
            )
        });
        vec![
            (
                "start to first update",
                format!(
                    "{} without the warm-up, target {TARGET_SECONDS} s; {} starts",
                    self.start_seconds.show(),
                    self.starts
                ),
            ),
            (
                "  in detail",
                format!(
                    "every role ready after {}\nwarm-up of {} rows: {}\nfrom there to the first update {}",
                    self.ready_seconds.show(),
                    self.warm_up_rows,
                    self.warm_up_seconds.show(),
                    self.first_update_seconds.show()
                ),
            ),
            (
                "killed learner to next update",
                format!(
                    "{}, target {TARGET_SECONDS} s; {} kills\nits successor ready after {}",
                    self.recovery_seconds.show(),
                    self.kills,
                    self.successor_ready_seconds.show()
                ),
            ),
            (
                "memory of each process",
                format!(
                    "{}\ntarget {:.0} MB private, not counting the replay",
                    roles.collect::<Vec<_>>().join("\n"),
                    TARGET_BYTES as f64 / MEGABYTE
                ),
            ),
        ]
    }
}
