//! How rows a second grow with actors, from the environments to the committed replay: real processes, as a run has them, but
//! for the launcher and the evaluator. Beside it what a model of queues expects, here and where every process has a core.

use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use serde::Serialize;

use super::costs::{self, Costs};
use super::flow::{Flow, LOOK};
use super::measurement::{Figures, Patience};
use super::model::{Bottleneck, Stages};
use super::one_core::{self, OneCore};
use super::processes::Processes;
use super::rows::ENVIRONMENTS;
use super::scene::{Scene, counted_settings};
use super::window::Windows;

mod table;

const WINDOW: Duration = Duration::from_millis(100);

/// What part of the time goes to counting, to the pair on one core, and to the stages one by one.
const SHARES: [f64; 3] = [0.5, 0.25, 0.25];

/// Part of a count's time that goes before, to warm up.
const WARM_UP: f64 = 0.2;

/// More than a run can be scaled to.
const MOST: u32 = 256;

/// Actors that the model is asked about.
const ASKED: [u32; 7] = [1, 2, 4, 8, 16, 32, 64];

/// The fields of `bench actors --json`.
#[derive(Serialize)]
pub(super) struct ActorFigures {
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

/// What so many actors gave.
#[derive(Serialize)]
struct Count {
    actors: u32,
    /// Actors, environment servers and the learner.
    processes: u32,
    more_processes_than_cores: bool,
    /// The learner makes no updates.
    collecting: Rate,
    /// The learner makes as many updates as it can, and takes everything in.
    learning: Rate,
}

#[derive(Serialize)]
struct Rate {
    rows_per_second: f64,
    updates_per_second: f64,
    /// Rows a second over as many times those of one actor.
    efficiency: f64,
    expected_rows_per_second: f64,
    expected_updates_per_second: f64,
    #[serde(skip)]
    windows: Windows,
}

/// What the model expects where every process has a core of its own.
#[derive(Serialize)]
struct Scaling {
    actors: u32,
    rows_per_second: f64,
    efficiency: f64,
    learning_rows_per_second: f64,
    learning_updates_per_second: f64,
    learning_efficiency: f64,
}

/// The counts that somebody typed, or those that make sense here; always with one actor, which the others are held against.
fn counts(typed: Option<&str>, cores: u32) -> anyhow::Result<Vec<u32>> {
    let mut counts = match typed {
        Some(text) => {
            let number = |part: &str| part.trim().parse().ok().filter(|n| (1..=MOST).contains(n));
            let numbers: Option<Vec<u32>> = text.split(',').map(number).collect();
            numbers
                .with_context(|| format!("--actors {text:?}: must be numbers from 1 to {MOST}, as in --actors 1,2,4"))?
        }
        None => ASKED.into_iter().filter(|n| *n <= cores.max(4)).collect(),
    };
    counts.push(1);
    counts.sort_unstable();
    counts.dedup();
    Ok(counts)
}

pub(super) fn measure(typed: Option<&str>, patience: &Patience) -> anyhow::Result<ActorFigures> {
    let cores = std::thread::available_parallelism().map_or(1, |cores| cores.get() as u32);
    let counts = counts(typed, cores)?;
    let [counting, alone, stages] = SHARES.map(|share| patience.length.mul_f64(share));
    let each = counting / (2 * counts.len() as u32);
    let mut counted = Vec::new();
    for actors in counts {
        counted.push((
            actors,
            count(actors, false, each, patience)?,
            count(actors, true, each, patience)?,
        ));
    }
    let one_core = one_core::measure(alone, patience)?;
    let costs = costs::measure(stages, patience)?;

    let config = Scene::of(1, ENVIRONMENTS as u32, &[])?.remove_directory()?;
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
        None => bail!("nothing was counted"),
    };
    let counts = counted.into_iter().map(|(actors, collecting, learning)| {
        let rate = |(windows, updates): (Windows, f64), one: f64, with_updates| {
            let expected = stages.on(cores, actors, with_updates);
            Rate {
                rows_per_second: windows.median(),
                updates_per_second: updates,
                efficiency: windows.median() / (f64::from(actors) * one),
                expected_rows_per_second: rows * expected.chunks_per_second,
                expected_updates_per_second: expected.updates_per_second,
                windows,
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
    Ok(ActorFigures {
        cores,
        environments_per_actor: ENVIRONMENTS,
        chunk_rows: config.chunk_rows(),
        window_chunks: config.actors.window,
        counts: counts.collect(),
        one_core,
        costs,
        scaling: ASKED.map(|actors| scaling(&stages, actors, rows)).into(),
        first_bottleneck: stages.first_bottleneck_alone(false),
        first_bottleneck_with_updates: stages.first_bottleneck_alone(true),
        first_bottleneck_on_these_cores: stages.first_bottleneck_on(cores),
    })
}

fn scaling(stages: &Stages, actors: u32, rows: f64) -> Scaling {
    let of = |actors, updates| stages.alone(actors, updates).chunks_per_second * rows;
    let efficiency = |updates| of(actors, updates) / (f64::from(actors) * of(1, updates));
    Scaling {
        actors,
        rows_per_second: of(actors, false),
        efficiency: efficiency(false),
        learning_rows_per_second: of(actors, true),
        learning_updates_per_second: stages.alone(actors, true).updates_per_second,
        learning_efficiency: efficiency(true),
    }
}

/// Rows a second of so many actors, and the learner's updates a second.
fn count(actors: u32, updates: bool, length: Duration, patience: &Patience) -> anyhow::Result<(Windows, f64)> {
    let scene = Scene::of(actors, ENVIRONMENTS as u32, &counted_settings(actors, updates))?;
    scene.with_crew(
        |_| None,
        |domain, processes| {
            let mut flow = Flow::begin(&scene, domain, processes, patience)?;
            flow.sleep(length.mul_f64(WARM_UP), processes, patience)?;
            watch(&mut flow, length.mul_f64(1.0 - WARM_UP), processes, patience)
        },
    )
}

fn watch(
    flow: &mut Flow<'_>,
    length: Duration,
    processes: &mut Processes,
    patience: &Patience,
) -> anyhow::Result<(Windows, f64)> {
    let mut windows = Windows::default();
    let mut published: Vec<(Instant, u64)> = Vec::new();
    let (begun, mut opened) = (Instant::now(), (Instant::now(), flow.rows()));
    let window = WINDOW.min(length);
    loop {
        std::thread::sleep(LOOK);
        let (now, updates) = (Instant::now(), flow.updates()?);
        if updates > 0 && published.last().is_none_or(|(_, before)| updates > *before) {
            published.push((now, updates));
        }
        if now - opened.0 < window {
            continue;
        }
        let rows = flow.rows();
        windows.add((rows - opened.1) as f64 / (now - opened.0).as_secs_f64());
        opened = (now, rows);
        patience.check()?;
        processes.check()?;
        // Two policies are the least that a rate can be taken from.
        if now - begun >= length && (!flow.expects_updates() || published.len() > 1) {
            break;
        }
    }
    let rate = match (published.first(), published.last()) {
        (Some((then, first)), Some((now, last))) if last > first => {
            (last - first) as f64 / (*now - *then).as_secs_f64()
        }
        _ => 0.0,
    };
    Ok((windows, rate))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_begin_with_one_actor_and_end_with_what_the_machine_has() {
        assert_eq!(counts(None, 2).unwrap(), [1, 2, 4]);
        assert_eq!(counts(None, 20).unwrap(), [1, 2, 4, 8, 16]);
        assert_eq!(counts(Some("3, 2,3"), 2).unwrap(), [1, 2, 3]);
    }

    #[test]
    fn what_is_no_list_of_counts_is_refused_in_one_line() {
        for typed in ["", "0", "1,,2", "two", "-1", "1.5", "257", "1025", "99999999999"] {
            let message = counts(Some(typed), 2).unwrap_err().to_string();
            assert!(message.contains("--actors") && !message.contains('\n'), "{message}");
        }
    }
}
