//! How many actions a second the policy gives, as an actor asks it.

use std::time::Duration;

use serde::Serialize;
use shoal_common::network::{ActionRange, PolicyNetwork};
use shoal_learner::initialise::initialise;

use super::rows::{ENVIRONMENTS, Rows};
use super::scene::{Scene, ddpg};
use super::window::{self, Windows};
use super::{Figures, Patience};

const WINDOW: Duration = Duration::from_millis(50);

/// Part of the time that goes before, to warm up.
const WARM_UP: f64 = 0.05;

/// The fields of `bench policy --json`.
#[derive(Serialize)]
pub(super) struct PolicyFigures {
    actions_per_second_batch_1: f64,
    actions_per_second_batch_64: f64,
    microseconds_per_call_batch_1: f64,
    microseconds_per_call_batch_64: f64,
    parameters: usize,
    threads: u32,
    #[serde(skip)]
    calls: [Windows; 2],
}

pub(super) fn measure(patience: &Patience) -> anyhow::Result<PolicyFigures> {
    let scene = Scene::new(&[])?;
    let config = scene.remove_directory()?;
    let range = ActionRange::new(&config.spec.action)?;
    let width = config.spec.observation.width();
    let mut actions = vec![0.0; ENVIRONMENTS * range.width()];
    let mut policy = PolicyNetwork::new(width, ddpg(&config)?.hidden, range, ENVIRONMENTS);
    let parameters = initialise(policy.layout(), config.run.seed, 0);
    let rows = Rows::new(&config)?;

    let mut calls_of = |batch: usize, length| {
        let actions = &mut actions[..batch * policy.range().width()];
        let observations = &rows.observations()[..batch * width];
        window::rate(length, || {
            policy.forward(&parameters, std::hint::black_box(observations), actions);
            std::hint::black_box(&mut *actions);
        })
    };
    let batches = [1, ENVIRONMENTS];
    for batch in batches {
        calls_of(batch, patience.length.mul_f64(WARM_UP));
    }
    let mut calls: [Windows; 2] = Default::default();
    for _ in 0..window::count(patience.length, 0.5, WINDOW) {
        patience.check()?;
        for (windows, batch) in calls.iter_mut().zip(batches) {
            windows.add(calls_of(batch, WINDOW));
        }
    }
    let [one, many] = [calls[0].median(), calls[1].median()];
    Ok(PolicyFigures {
        actions_per_second_batch_1: one,
        actions_per_second_batch_64: many * ENVIRONMENTS as f64,
        microseconds_per_call_batch_1: 1e6 / one,
        microseconds_per_call_batch_64: 1e6 / many,
        parameters: parameters.len(),
        threads: 1,
        calls,
    })
}

impl Figures for PolicyFigures {
    fn lines(&self) -> Vec<(&'static str, String)> {
        let line = |calls: &Windows, batch: usize, time: f64| {
            let unit = 1e3 / batch as f64;
            format!("{} thousand actions a second, {time:.1} µs a call", calls.show(unit, 0))
        };
        vec![
            (
                "one observation",
                line(&self.calls[0], 1, self.microseconds_per_call_batch_1),
            ),
            (
                "a batch of 64",
                line(&self.calls[1], ENVIRONMENTS, self.microseconds_per_call_batch_64),
            ),
            ("network", format!("{} parameters, one thread", self.parameters)),
        ]
    }
}
