//! Actions per second of the policy's forward pass, as actors use it, compared with the machine's limits.

use std::time::Duration;

use pulp::Arch;
use serde::Serialize;
use shoal_common::network::{ActionRange, DeterministicPolicy, NetworkLayout};
use shoal_common::stream::{Purpose, stream};
use shoal_learner::networks::initialise::initialise;
use shoal_learner::networks::product::{Product, Transposed};

use super::intervals::{self, Samples};
use super::measurement::{Figures, TimeBudget};
use super::product::TimedProduct;
use super::rows::{ENVIRONMENTS, Rows};
use super::target::{Line, Target};
use super::temporary_run::{TemporaryRun, ddpg};

const INTERVAL: Duration = Duration::from_millis(50);

/// Share of the time for each of four measurements: two batch sizes and the limit of each.
const SHARE: f64 = 0.25;

/// Share of the time that is spent on warming up.
const WARM_UP: f64 = 0.05;

/// Attempts per kernel at the product that serves as the limit.
const ATTEMPTS: usize = 10;

/// The fields of `bench policy --json`.
#[derive(Serialize)]
pub(super) struct PolicyFigures {
    actions_per_second_batch_1: f64,
    actions_per_second_batch_64: f64,
    microseconds_per_call_batch_1: f64,
    microseconds_per_call_batch_64: f64,
    /// Time to read every parameter once, from where a call leaves them in the caches.
    reading_microseconds: f64,
    share_of_reading: f64,
    flop_batch_64: u64,
    /// Rate of the second layer's product with the fastest kernel.
    limit_gflops: f64,
    share_of_limit: f64,
    parameters: usize,
    threads: u32,
    #[serde(skip)]
    calls: [Samples; 2],
}

pub(super) fn measure(budget: &TimeBudget) -> anyhow::Result<PolicyFigures> {
    let temporary = TemporaryRun::new(&[])?;
    let config = temporary.remove_directory()?;
    let range = ActionRange::new(&config.spec.action)?;
    let width = config.spec.observation.width();
    let mut actions = vec![0.0; ENVIRONMENTS * range.width()];
    let network = ddpg(&config)?.networks(&config.spec).actor;
    let mut policy = DeterministicPolicy::new(network, range, ENVIRONMENTS);
    let layout = *policy.layout();
    let parameters = initialise(&layout, config.run.seed, 0);
    let rows = Rows::new(&config)?;
    let mut product = widest_product(&layout, config.run.seed);

    let mut calls_of = |batch: usize, length| {
        let actions = &mut actions[..batch * policy.range().width()];
        let observations = &rows.observations()[..batch * width];
        intervals::rate(length, || {
            policy.forward(&parameters, std::hint::black_box(observations), actions);
            std::hint::black_box(&mut *actions);
        })
    };
    let batches = [1, ENVIRONMENTS];
    for batch in batches {
        calls_of(batch, budget.length.mul_f64(WARM_UP));
    }
    let mut calls: [Samples; 2] = Default::default();
    let (mut readings, mut limit) = (Samples::default(), Samples::default());
    for _ in 0..intervals::count(budget.length, SHARE, INTERVAL) {
        budget.check()?;
        for (results, batch) in calls.iter_mut().zip(batches) {
            results.add(calls_of(batch, INTERVAL));
        }
        readings.add(intervals::rate(INTERVAL, || read(std::hint::black_box(&parameters))));
        limit.add(product.gflops(INTERVAL));
    }
    let [one, many] = [calls[0].median(), calls[1].median()];
    let sizes = layout.layer_sizes();
    let flop: usize = sizes.map(|(i, o)| 2 * i * o * ENVIRONMENTS).sum();
    Ok(PolicyFigures {
        actions_per_second_batch_1: one,
        actions_per_second_batch_64: many * ENVIRONMENTS as f64,
        microseconds_per_call_batch_1: 1e6 / one,
        microseconds_per_call_batch_64: 1e6 / many,
        reading_microseconds: 1e6 / readings.median(),
        share_of_reading: one / readings.median(),
        flop_batch_64: flop as u64,
        limit_gflops: limit.median(),
        share_of_limit: many * flop as f64 / 1e9 / limit.median(),
        parameters: parameters.len(),
        threads: 1,
        calls,
    })
}

/// The second layer's product for a batch of 64, with its fastest kernel. It is nearly the whole computation.
fn widest_product(layout: &NetworkLayout, seed: u64) -> TimedProduct {
    let (k, m) = layout.layer_size(1);
    let product = Product {
        m,
        k,
        n: ENVIRONMENTS,
        transposed: Transposed::Neither,
    };
    let mut product = TimedProduct::new(product, &mut stream(seed, Purpose::Exploration, 1, 0));
    (0..ATTEMPTS).for_each(|_| product.try_kernels());
    product
}

/// Reads every number once and does as little as possible with it.
fn read(numbers: &[f32]) {
    let sums = Arch::new().dispatch(|| {
        let mut sums = [0.0_f32; 64];
        for numbers in numbers.chunks_exact(64) {
            for (sum, number) in sums.iter_mut().zip(numbers) {
                *sum += number;
            }
        }
        sums
    });
    std::hint::black_box(sums);
}

impl Figures for PolicyFigures {
    fn lines(&self) -> Vec<(&'static str, String)> {
        let line = |calls: &Samples, batch: usize, time: f64| {
            let unit = 1e3 / batch as f64;
            format!("{} thousand actions a second, {time:.1} µs a call", calls.show(unit, 0))
        };
        vec![
            (
                "one observation",
                line(&self.calls[0], 1, self.microseconds_per_call_batch_1),
            ),
            (
                "  share of the limit",
                format!(
                    "{:.2}: reading the parameters once takes {:.1} µs",
                    self.share_of_reading, self.reading_microseconds
                ),
            ),
            (
                "a batch of 64",
                line(&self.calls[1], ENVIRONMENTS, self.microseconds_per_call_batch_64),
            ),
            (
                "  share of the limit",
                format!(
                    "{:.2} of its largest product's rate, {:.0} GFLOP/s",
                    self.share_of_limit, self.limit_gflops
                ),
            ),
            ("network", format!("{} parameters, one thread", self.parameters)),
        ]
    }

    fn table(&self) -> Vec<Line> {
        vec![
            Line {
                stage: "policy, one observation",
                ours: format!("{:.1} µs", self.microseconds_per_call_batch_1),
                limit: format!("{:.1} µs to read its weights", self.reading_microseconds),
                share: Some(self.share_of_reading),
                target: Target::unchecked("as fast as reading"),
            },
            Line {
                stage: "policy, batch 64",
                ours: format!("{:.0} thousand actions/s", self.actions_per_second_batch_64 / 1e3),
                limit: format!("{:.0} GFLOP/s, its largest product", self.limit_gflops),
                share: Some(self.share_of_limit),
                target: Target::at_least(0.75, self.share_of_limit, "0.75 of the limit"),
            },
        ]
    }
}
