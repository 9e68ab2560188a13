//! How the rate of environment steps grows with the number of actors, from the environments to the committed replay.
//! The processes are a run's, without launcher and evaluator. A queueing model predicts the rates on this machine and
//! on one with a core for every process.

use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use serde::Serialize;

use super::costs::{self, Costs};
use super::intervals::Samples;
use super::measurement::{StageResults, TimeBudget};
use super::model::{Bottleneck, Stages};
use super::one_core::{self, OneCore};
use super::processes::Processes;
use super::progress::{POLL_INTERVAL, RunProgress};
use super::rows::ENVIRONMENTS;
use super::temporary_run::{TemporaryRun, settings_for_counting};

mod table;

const INTERVAL: Duration = Duration::from_millis(100);

/// Shares of the time: counting steps, the actor and its server on one core, and the separate stages.
const SHARES: [f64; 3] = [0.5, 0.25, 0.25];

/// Share of a count's time that is spent on warming up.
const WARM_UP: f64 = 0.2;

/// Most actors that `--actors` accepts.
const MAX_ACTORS: u32 = 256;

/// Numbers of actors for which the model predicts rates.
const MODEL_ACTORS: [u32; 7] = [1, 2, 4, 8, 16, 32, 64];

/// The fields of `bench actors --json`.
#[derive(Serialize)]
pub(super) struct ActorResults {
    cores: u32,
    environments_per_actor: usize,
    chunk_rows: usize,
    window_chunks: u32,
    counts: Vec<Count>,
    one_core: OneCore,
    costs: Costs,
    scaling: Vec<Scaling>,
    first_bottleneck: Bottleneck,
    first_bottleneck_with_updates: Bottleneck,
    first_bottleneck_on_these_cores: Bottleneck,
}

/// The rates of one number of actors.
#[derive(Serialize)]
struct Count {
    actors: u32,
    /// Actors, environment servers and the learner.
    processes: u32,
    more_processes_than_cores: bool,
    /// The learner makes no gradient steps.
    collecting: Rate,
    /// The learner receives everything and makes as many gradient steps as it can.
    learning: Rate,
}

#[derive(Serialize)]
struct Rate {
    rows_per_second: f64,
    updates_per_second: f64,
    /// The rate divided by (the rate of one actor × the number of actors).
    efficiency: f64,
    expected_rows_per_second: f64,
    expected_updates_per_second: f64,
    #[serde(skip)]
    results: Samples,
}

/// The model's prediction when every process has a core of its own.
#[derive(Serialize)]
struct Scaling {
    actors: u32,
    rows_per_second: f64,
    efficiency: f64,
    learning_rows_per_second: f64,
    learning_updates_per_second: f64,
    learning_efficiency: f64,
}

/// The numbers of actors to measure: the numbers that the user typed, or a default for this number of cores. One actor
/// is always included, because efficiency is relative to it.
fn counts(typed: Option<&str>, cores: u32) -> anyhow::Result<Vec<u32>> {
    let mut counts = match typed {
        Some(text) => {
            let number = |part: &str| part.trim().parse().ok().filter(|n| (1..=MAX_ACTORS).contains(n));
            let numbers: Option<Vec<u32>> = text.split(',').map(number).collect();
            numbers.with_context(|| {
                format!("--actors {text:?}: must be numbers from 1 to {MAX_ACTORS}, as in --actors 1,2,4")
            })?
        }
        None => MODEL_ACTORS.into_iter().filter(|n| *n <= cores.max(4)).collect(),
    };
    counts.push(1);
    counts.sort_unstable();
    counts.dedup();
    Ok(counts)
}

pub(super) fn measure(typed: Option<&str>, budget: &TimeBudget) -> anyhow::Result<ActorResults> {
    let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get() as u32);
    let counts = counts(typed, cores)?;
    let [counting, alone, stages] = SHARES.map(|share| budget.length.mul_f64(share));
    let each = counting / (2 * counts.len() as u32);
    let mut counted = Vec::new();
    for actors in counts {
        counted.push((
            actors,
            count(actors, false, each, budget)?,
            count(actors, true, each, budget)?,
        ));
    }
    let one_core = one_core::measure(alone, budget)?;
    let costs = costs::measure(stages, budget)?;

    let config = TemporaryRun::of(1, ENVIRONMENTS as u32, &[])?.remove_directory()?;
    let (rows, steps) = (config.chunk_rows() as f64, f64::from(config.actors.chunk_steps));
    let stages = Stages {
        think: (steps * (costs.acting_us + costs.round_trip_us) + costs.writing_chunk_us) / 1e6,
        think_on_one_core: rows / one_core.pair_rows_per_second,
        intake: costs.intake_of_chunk_us / 1e6,
        update: costs.update_us / 1e6,
        window: config.actors.window,
    };
    let [first, first_learning] = match counted.first() {
        Some((_, collecting, learning)) => [collecting.0.median(), learning.0.median()],
        None => bail!("no number of actors was measured"),
    };
    let counts = counted.into_iter().map(|(actors, collecting, learning)| {
        let rate = |(results, updates): (Samples, f64), one: f64, with_updates| {
            let expected = stages.on_cores(cores, actors, with_updates);
            Rate {
                rows_per_second: results.median(),
                updates_per_second: updates,
                efficiency: results.median() / (f64::from(actors) * one),
                expected_rows_per_second: rows * expected.chunks_per_second,
                expected_updates_per_second: expected.updates_per_second,
                results,
            }
        };
        Count {
            actors,
            processes: 2 * actors + 1,
            more_processes_than_cores: 2 * actors + 1 > cores,
            collecting: rate(collecting, first, false),
            learning: rate(learning, first_learning, true),
        }
    });
    Ok(ActorResults {
        cores,
        environments_per_actor: ENVIRONMENTS,
        chunk_rows: config.chunk_rows(),
        window_chunks: config.actors.window,
        counts: counts.collect(),
        one_core,
        costs,
        scaling: MODEL_ACTORS.map(|actors| scaling(&stages, actors, rows)).into(),
        first_bottleneck: stages.first_bottleneck_with_own_cores(false),
        first_bottleneck_with_updates: stages.first_bottleneck_with_own_cores(true),
        first_bottleneck_on_these_cores: stages.first_bottleneck_on_cores(cores),
    })
}

fn scaling(stages: &Stages, actors: u32, rows: f64) -> Scaling {
    let of = |actors, updates| stages.with_own_cores(actors, updates).chunks_per_second * rows;
    let efficiency = |updates| of(actors, updates) / (f64::from(actors) * of(1, updates));
    Scaling {
        actors,
        rows_per_second: of(actors, false),
        efficiency: efficiency(false),
        learning_rows_per_second: of(actors, true),
        learning_updates_per_second: stages.with_own_cores(actors, true).updates_per_second,
        learning_efficiency: efficiency(true),
    }
}

/// The rate of committed rows with `actors` actors in each interval, and the learner's gradient steps per second.
fn count(actors: u32, updates: bool, length: Duration, budget: &TimeBudget) -> anyhow::Result<(Samples, f64)> {
    let temporary = TemporaryRun::of(actors, ENVIRONMENTS as u32, &settings_for_counting(actors, updates))?;
    temporary.with_processes(
        |_| None,
        |domain, processes| {
            let mut progress = RunProgress::begin(&temporary, domain, processes, budget)?;
            progress.sleep(length.mul_f64(WARM_UP), processes, budget)?;
            watch(&mut progress, length.mul_f64(1.0 - WARM_UP), processes, budget)
        },
    )
}

fn watch(
    progress: &mut RunProgress<'_>,
    length: Duration,
    processes: &mut Processes,
    budget: &TimeBudget,
) -> anyhow::Result<(Samples, f64)> {
    let mut results = Samples::default();
    let mut published: Vec<(Instant, u64)> = Vec::new();
    let (begun, mut opened) = (Instant::now(), (Instant::now(), progress.rows()));
    let interval = INTERVAL.min(length);
    loop {
        std::thread::sleep(POLL_INTERVAL);
        let (now, updates) = (Instant::now(), progress.updates()?);
        if updates > 0 && published.last().is_none_or(|(_, before)| updates > *before) {
            published.push((now, updates));
        }
        if now - opened.0 < interval {
            continue;
        }
        let rows = progress.rows();
        results.add((rows - opened.1) as f64 / (now - opened.0).as_secs_f64());
        opened = (now, rows);
        budget.check()?;
        processes.check()?;
        // A rate of gradient steps needs two published policies.
        if now - begun >= length && (!progress.expects_updates() || published.len() > 1) {
            break;
        }
    }
    let rate = match (published.first(), published.last()) {
        (Some((then, first)), Some((now, last))) if last > first => {
            (last - first) as f64 / (*now - *then).as_secs_f64()
        }
        _ => 0.0,
    };
    Ok((results, rate))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn default_counts_depend_on_the_cores_and_always_include_one_actor() {
        assert_eq!(counts(None, 2).unwrap(), [1, 2, 4]);
        assert_eq!(counts(None, 20).unwrap(), [1, 2, 4, 8, 16]);
        assert_eq!(counts(Some("3, 2,3"), 2).unwrap(), [1, 2, 3]);
    }

    #[test]
    fn an_invalid_list_of_counts_is_refused_in_one_line() {
        for typed in ["", "0", "1,,2", "two", "-1", "1.5", "257", "1025", "99999999999"] {
            let message = counts(Some(typed), 2).unwrap_err().to_string();
            assert!(message.contains("--actors") && !message.contains('\n'), "{message}");
        }
    }
}
