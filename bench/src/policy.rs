//! Actions per second of the policy, as evaluator and actors use it, compared with the machine's limits.

use std::time::Duration;

use anyhow::bail;
use pulp::Arch;
use serde::Serialize;
use shoal_actor::exploration::{Exploration, StepCounts};
use shoal_common::network::{Network, NetworkLayout};
use shoal_common::policy::PolicyLayout;
use shoal_common::stream::{Purpose, stream};
use shoal_learner::networks::initialise::small_output;
use shoal_learner::networks::product::{Product, Transposed};

use super::intervals::{self, Samples};
use super::measurement::{StageResults, TimeBudget};
use super::product::TimedProduct;
use super::rows::{ENVIRONMENTS, Rows};
use super::target::{Target, TargetRow};
use super::temporary_run::TemporaryRun;

const INTERVAL: Duration = Duration::from_millis(50);

/// Share of the time for each of six measurements: two batch sizes, the limit of each, and for the larger batch the
/// network alone and the policy with exploration.
const SHARE: f64 = 1.0 / 6.0;

/// Share of the time that is spent on warming up.
const WARM_UP: f64 = 0.05;

/// Attempts per kernel at the product that serves as the limit.
const ATTEMPTS: usize = 10;

/// The fields of `bench policy --json`.
#[derive(Serialize)]
pub(super) struct PolicyResults {
    #[serde(rename = "method")]
    algorithm: String,
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
    /// Actions for 64 observations as actors choose them: with noise, drawn from a distribution, or by chance.
    actions_per_second_exploring: f64,
    microseconds_per_call_exploring: f64,
    share_of_limit_exploring: f64,
    /// Share of the time of an exploring call that the network does not take: random numbers, squashing, choice.
    share_of_exploration: f64,
    parameters: usize,
    threads: u32,
    #[serde(skip)]
    calls: [Samples; 2],
    #[serde(skip)]
    exploring: Samples,
}

/// Measures one of the [algorithms](super::algorithms), by default DDPG.
pub(super) fn measure(algorithm: Option<&str>, budget: &TimeBudget) -> anyhow::Result<PolicyResults> {
    let temporary = TemporaryRun::with_algorithm(algorithm)?;
    let config = temporary.remove_directory()?;
    let (width, action_width) = (config.spec.observation.width(), config.spec.action.width());
    let layout = network_of(config.policy_layout()?)?;
    let parameters = small_output(&layout, config.run.seed, 0);
    let rows = Rows::new(&config)?;
    let mut actions = vec![0.0; ENVIRONMENTS * action_width];
    let mut policy = config.policy(ENVIRONMENTS)?;
    let mut network = Network::new(layout, ENVIRONMENTS);
    let mut outputs = vec![0.0; ENVIRONMENTS * layout.outputs()];
    let random = stream(config.run.seed, Purpose::Exploration, 0, 0);
    let mut exploration = Exploration::new(config.behaviour(ENVIRONMENTS)?, ENVIRONMENTS, random);
    // At the end of the run, when ε has its last value.
    let mut steps = StepCounts {
        step: 0,
        env_steps: config.run.steps,
    };
    let mut product = widest_product(&layout, config.run.seed);

    let mut calls_of = |batch: usize, length| {
        let actions = &mut actions[..batch * action_width];
        let observations = &rows.observations()[..batch * width];
        intervals::rate(length, || {
            policy.act(&parameters, std::hint::black_box(observations), actions);
            std::hint::black_box(&mut *actions);
        })
    };
    let mut network_calls = |length| {
        intervals::rate(length, || {
            network.forward(&parameters, std::hint::black_box(rows.observations()), &mut outputs);
            std::hint::black_box(&mut outputs);
        })
    };
    let mut exploring_actions = vec![0.0; ENVIRONMENTS * action_width];
    let mut exploring_calls = |length| {
        intervals::rate(length, || {
            let observations = std::hint::black_box(rows.observations());
            exploration.act(&parameters, observations, steps, &mut exploring_actions);
            steps.step += 1;
            std::hint::black_box(&mut exploring_actions);
        })
    };
    let batches = [1, ENVIRONMENTS];
    let warm_up = budget.length.mul_f64(WARM_UP);
    for batch in batches {
        calls_of(batch, warm_up);
    }
    exploring_calls(warm_up);
    let mut calls: [Samples; 2] = Default::default();
    let (mut readings, mut limit) = (Samples::default(), Samples::default());
    let (mut alone, mut exploring) = (Samples::default(), Samples::default());
    for _ in 0..intervals::count(budget.length, SHARE, INTERVAL) {
        budget.check()?;
        for (results, batch) in calls.iter_mut().zip(batches) {
            results.add(calls_of(batch, INTERVAL));
        }
        alone.add(network_calls(INTERVAL));
        exploring.add(exploring_calls(INTERVAL));
        readings.add(intervals::rate(INTERVAL, || read(std::hint::black_box(&parameters))));
        limit.add(product.gflops(INTERVAL));
    }
    let [one, many] = [calls[0].median(), calls[1].median()];
    let sizes = layout.layer_sizes();
    let flop: usize = sizes.map(|(i, o)| 2 * i * o * ENVIRONMENTS).sum();
    let share_of_limit = |calls_per_second: f64| calls_per_second * flop as f64 / 1e9 / limit.median();
    Ok(PolicyResults {
        algorithm: config.algorithm.name().into(),
        actions_per_second_batch_1: one,
        actions_per_second_batch_64: many * ENVIRONMENTS as f64,
        microseconds_per_call_batch_1: 1e6 / one,
        microseconds_per_call_batch_64: 1e6 / many,
        reading_microseconds: 1e6 / readings.median(),
        share_of_reading: one / readings.median(),
        flop_batch_64: flop as u64,
        limit_gflops: limit.median(),
        share_of_limit: share_of_limit(many),
        actions_per_second_exploring: exploring.median() * ENVIRONMENTS as f64,
        microseconds_per_call_exploring: 1e6 / exploring.median(),
        share_of_limit_exploring: share_of_limit(exploring.median()),
        share_of_exploration: 1.0 - exploring.median() / alone.median(),
        parameters: parameters.len(),
        threads: 1,
        calls,
        exploring,
    })
}

/// The network of a policy.
fn network_of(layout: PolicyLayout) -> anyhow::Result<NetworkLayout> {
    match layout {
        PolicyLayout::Deterministic(network)
        | PolicyLayout::Gaussian(network)
        | PolicyLayout::Softmax(network)
        | PolicyLayout::ActionValues(network)
        | PolicyLayout::Dueling(network) => Ok(network),
        PolicyLayout::Table { .. } => bail!("a table has no network to measure"),
    }
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

impl StageResults for PolicyResults {
    fn entries(&self) -> Vec<(&'static str, String)> {
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
            (
                "  with exploration",
                line(&self.exploring, ENVIRONMENTS, self.microseconds_per_call_exploring),
            ),
            (
                "  share of the limit",
                format!(
                    "{:.2}; exploration takes {:.0} % of the time",
                    self.share_of_limit_exploring,
                    100.0 * self.share_of_exploration
                ),
            ),
            (
                "network",
                format!("{}, {} parameters, one thread", self.algorithm, self.parameters),
            ),
        ]
    }

    fn target_rows(&self) -> Vec<TargetRow> {
        vec![
            TargetRow {
                stage: "policy, one observation",
                ours: format!("{:.1} µs", self.microseconds_per_call_batch_1),
                limit: format!("{:.1} µs to read its weights", self.reading_microseconds),
                share: Some(self.share_of_reading),
                target: Target::unchecked("as fast as reading"),
            },
            TargetRow {
                stage: "policy, batch 64",
                ours: format!("{:.0} thousand actions/s", self.actions_per_second_batch_64 / 1e3),
                limit: format!("{:.0} GFLOP/s, its largest product", self.limit_gflops),
                share: Some(self.share_of_limit),
                target: Target::at_least(0.75, self.share_of_limit, "0.75 of the limit"),
            },
        ]
    }
}
