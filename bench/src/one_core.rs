//! How much of a core an actor leaves to its policy: an actor and its environment server share one core, and what they give
//! is held against the policy alone on the same core. Both take turns, so that what else the machine does strikes both.

use std::time::{Duration, Instant};

use rustix::thread::sched_setaffinity;
use serde::Serialize;
use shoal_common::report::Role;

use super::cores::Cores;
use super::costs::Inference;
use super::flow::Flow;
use super::measurement::Patience;
use super::processes::Processes;
use super::rows::ENVIRONMENTS;
use super::scene::{Scene, counted_settings};
use super::window::{self, Windows};

/// A turn of the actor and its server; a turn of the policy alone takes half of it.
const TURN: Duration = Duration::from_millis(200);

/// What the share should be.
pub(super) const TARGET: f64 = 0.8;

#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct OneCore {
    pub(super) pair_rows_per_second: f64,
    pub(super) inference_rows_per_second: f64,
    /// Median over turns of the first over the second.
    pub(super) share: f64,
    pub(super) share_least: f64,
    pub(super) share_greatest: f64,
    /// Whether the learner had another core.
    pub(super) learner_apart: bool,
}

/// Measures for about `length`.
pub(super) fn measure(length: Duration, patience: &Patience) -> anyhow::Result<OneCore> {
    let scene = Scene::of(1, ENVIRONMENTS as u32, &counted_settings(1, false))?;
    let mut inference = Inference::new(&scene.config)?;
    let cores = Cores::choose()?;
    let chosen = |role| {
        Some(match role {
            Role::Learner => cores.others,
            _ => cores.pair,
        })
    };
    scene.with_crew(chosen, |domain, processes| {
        let mut flow = Flow::begin(&scene, domain, processes, patience)?;
        let turns = window::count(length, 1.0, TURN.mul_f64(1.5));
        let turn = TURN.min(length.div_f64(1.5));
        take_turns(&mut flow, processes, &cores, turns, turn, &mut inference, patience)
    })
}

fn take_turns(
    flow: &mut Flow<'_>,
    processes: &mut Processes,
    cores: &Cores,
    turns: usize,
    turn: Duration,
    inference: &mut Inference,
    patience: &Patience,
) -> anyhow::Result<OneCore> {
    let (mut pair, mut alone, mut shares) = (Windows::default(), Windows::default(), Windows::default());
    for _ in 0..turns {
        sched_setaffinity(None, &cores.others)?;
        // The pair has just been woken.
        std::thread::sleep(turn / 10);
        let (begun, before) = (Instant::now(), flow.rows());
        flow.sleep(turn, processes, patience)?;
        let rows = (flow.rows() - before) as f64 / begun.elapsed().as_secs_f64();
        let rate = processes.with_actors_paused(|| -> anyhow::Result<f64> {
            sched_setaffinity(None, &cores.pair)?;
            inference.step();
            Ok(window::rate(turn / 2, || inference.step()))
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
