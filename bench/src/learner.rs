//! Gradient steps per second of the learner, compared with the machine's rate of matrix products.

use std::time::Duration;

use anyhow::Context;
use serde::Serialize;
use shoal_common::commit::ChunkId;
use shoal_common::config::Config;
use shoal_common::stream::{Purpose, stream};
use shoal_learner::algorithms::algorithm::Algorithm;
use shoal_learner::algorithms::registry;
use shoal_learner::networks::product::Products;
use shoal_learner::networks::threads::Threads;
use shoal_learner::replay::Replay;
use toml::{Table, Value};

use super::intervals::{self, Samples};
use super::measurement::{StageResults, TimeBudget};
use super::product::TimedProduct;
use super::rows::{ENVIRONMENTS, Rows};
use super::target::{Target, TargetRow};
use super::temporary_run::TemporaryRun;

const INTERVAL: Duration = Duration::from_millis(100);

/// Share of the time for each of seven measurements: for both minibatch sizes the gradient steps, the fastest product
/// and all products; and gradient steps on two threads. An algorithm with large minibatches has only four measurements.
const SHARE: f64 = 1.0 / 7.0;

/// The second minibatch size, large enough that Adam takes little of the time.
const LARGE_BATCH: usize = 256;

/// Attempts per shape and kernel; the best one counts when kernels and shapes are compared.
const ATTEMPTS: usize = 10;

/// Share of the time for warming up, until Adam's moments and the caches have settled.
const WARM_UP: f64 = 0.05;

/// The fields of `bench learner --json`.
#[derive(Serialize)]
pub(super) struct LearnerResults {
    #[serde(rename = "method")]
    algorithm: String,
    #[serde(flatten)]
    configured: BatchResults,
    /// Missing if the configured minibatches have this size.
    #[serde(skip_serializing_if = "Option::is_none")]
    large_batch: Option<BatchResults>,
    two_threads: TwoThreads,
    replay_rows: u64,
}

/// The results for one minibatch size, on one thread. An update is one gradient step of every network.
#[derive(Serialize)]
struct BatchResults {
    batch: usize,
    updates_per_second: f64,
    /// Counts the matrix products only.
    flop_per_update: u64,
    /// Rate of the update's fastest product with the fastest kernel.
    limit_gflops: f64,
    share_of_limit: f64,
    limit_product: String,
    limit_kernel: &'static str,
    /// Rate of all products of an update in their order, each with its fastest kernel.
    products_gflops: f64,
    share_of_products: f64,
    #[serde(skip)]
    updates: Samples,
    #[serde(skip)]
    limit: Samples,
    #[serde(skip)]
    products: Samples,
}

/// The configured minibatch size, on two threads.
#[derive(Serialize)]
struct TwoThreads {
    updates_per_second: f64,
    /// Relative to one thread.
    speedup: f64,
    #[serde(skip)]
    updates: Samples,
}

/// Measures one of the [algorithms](super::algorithms), by default DDPG.
pub(super) fn measure(algorithm: Option<&str>, budget: &TimeBudget) -> anyhow::Result<LearnerResults> {
    let temporary = TemporaryRun::with_algorithm(algorithm)?;
    let replay = Replay::create(&temporary.run.replay_file(), &temporary.replay_layout())?;
    // The mapping outlives the file, so nothing is left behind even if this process is killed.
    let config = temporary.remove_directory()?;
    let replay = filled(&config, replay, budget)?;

    let batch = config.algorithm.settings().batch();
    let mut configured = Case::new(&config, batch)?;
    let mut large = (batch != LARGE_BATCH)
        .then(|| Case::new(&config, LARGE_BATCH))
        .transpose()?;
    let mut shared = new_algorithm(&config, batch)?;
    shared.set_threads(Threads::two_threads()?);
    let mut updates_of_two = Samples::default();
    let cases = [&mut configured]
        .into_iter()
        .chain(&mut large)
        .map(|case| &mut case.algorithm);
    for algorithm in cases.chain([&mut shared]) {
        intervals::rate(budget.length.mul_f64(WARM_UP), || update(algorithm, &replay));
    }
    for _ in 0..intervals::count(budget.length, SHARE, INTERVAL) {
        budget.check()?;
        configured.measure(&replay);
        updates_of_two.add(intervals::rate(INTERVAL, || update(&mut shared, &replay)));
        large.iter_mut().for_each(|large| large.measure(&replay));
    }

    let configured = configured.results();
    Ok(LearnerResults {
        algorithm: config.algorithm.name().into(),
        two_threads: TwoThreads {
            updates_per_second: updates_of_two.median(),
            speedup: updates_of_two.median() / configured.updates_per_second,
            updates: updates_of_two,
        },
        configured,
        large_batch: large.map(Case::results),
        replay_rows: replay.head(),
    })
}

/// The configuration with minibatches of this size.
fn with_batch(config: &Config, size: usize) -> anyhow::Result<Config> {
    let mut table: Table = config.to_toml()?.parse()?;
    if let Some(Value::Table(section)) = table.get_mut(config.algorithm.name()) {
        section.insert("batch".into(), i64::try_from(size)?.into());
    }
    Ok(Config::from_table(table, "bench")?)
}

/// Fills the replay to its capacity.
fn filled(config: &Config, mut replay: Replay, budget: &TimeBudget) -> anyhow::Result<Replay> {
    let row = config.row_layout();
    let mut rows = Rows::new(config)?;
    let mut chunk = vec![0.0; ENVIRONMENTS * row.width()];
    for sequence in 1..=config.replay.capacity / ENVIRONMENTS as u64 {
        budget.check()?;
        rows.fill(&mut chunk)?;
        let id = ChunkId {
            incarnation: 0,
            sequence,
        };
        replay
            .append_and_commit(0, id, &chunk)
            .context("cannot fill the replay")?;
    }
    Ok(replay)
}

/// The run's algorithm with minibatches of `batch` rows.
fn new_algorithm(config: &Config, batch: usize) -> anyhow::Result<Box<dyn Algorithm>> {
    Ok(registry::new(&with_batch(config, batch)?)?)
}

/// One gradient step, as in the learner's loop.
fn update(algorithm: &mut Box<dyn Algorithm>, replay: &Replay) {
    std::hint::black_box(algorithm.update(replay, replay.head()));
}

/// The measurement of one minibatch size.
struct Case {
    algorithm: Box<dyn Algorithm>,
    batch: usize,
    flop_per_update: u64,
    /// The number of updates whose products are in the sequence.
    updates_in_sequence: f64,
    sequence: ProductSequence,
    fastest: TimedProduct,
    updates: Samples,
    limit: Samples,
    products: Samples,
}

impl Case {
    fn new(config: &Config, batch: usize) -> anyhow::Result<Self> {
        let products = registry::products(&with_batch(config, batch)?);
        let (sequence, fastest) = product_sequence(config, &products);
        Ok(Self {
            algorithm: new_algorithm(config, batch)?,
            batch,
            flop_per_update: products.flop_per_update(),
            updates_in_sequence: products.updates as f64,
            sequence,
            fastest,
            updates: Samples::default(),
            limit: Samples::default(),
            products: Samples::default(),
        })
    }

    /// Adds the result of one interval to each measurement.
    fn measure(&mut self, replay: &Replay) {
        let flop_of_sequence = self.flop_per_update as f64 * self.updates_in_sequence;
        self.updates
            .add(intervals::rate(INTERVAL, || update(&mut self.algorithm, replay)));
        self.limit.add(self.fastest.gflops(INTERVAL));
        self.products
            .add(intervals::rate(INTERVAL, || self.sequence.multiply_all()) * flop_of_sequence / 1e9);
    }

    fn results(self) -> BatchResults {
        let flop = self.flop_per_update;
        let achieved = flop as f64 * self.updates.median() / 1e9;
        BatchResults {
            batch: self.batch,
            updates_per_second: self.updates.median(),
            flop_per_update: flop,
            limit_gflops: self.limit.median(),
            share_of_limit: achieved / self.limit.median(),
            limit_product: self.fastest.shape(),
            limit_kernel: self.fastest.kernel.name(),
            products_gflops: self.products.median(),
            share_of_products: achieved / self.products.median(),
            updates: self.updates,
            limit: self.limit,
            products: self.products,
        }
    }
}

/// An update's products in their order. A repeated shape uses the same matrices again.
struct ProductSequence {
    distinct: Vec<TimedProduct>,
    order: Vec<usize>,
}

impl ProductSequence {
    fn multiply_all(&mut self) {
        for &i in &self.order {
            self.distinct[i].multiply();
        }
    }
}

/// All products, each with its best kernel, and a copy of the fastest one.
fn product_sequence(config: &Config, products: &Products) -> (ProductSequence, TimedProduct) {
    let mut random = stream(config.run.seed, Purpose::Exploration, 1, 0);
    let (mut distinct, mut order): (Vec<TimedProduct>, Vec<usize>) = Default::default();
    for &product in &products.products {
        let known = distinct.iter().position(|known| known.product == product);
        order.push(known.unwrap_or(distinct.len()));
        if known.is_none() {
            distinct.push(TimedProduct::new(product, &mut random));
        }
    }
    // In turn, so that a disturbance does not affect all attempts at one shape.
    for _ in 0..ATTEMPTS {
        distinct.iter_mut().for_each(TimedProduct::try_kernels);
    }
    let best = (0..distinct.len()).fold(0, |best, i| {
        if distinct[i].best > distinct[best].best {
            i
        } else {
            best
        }
    });
    let mut fastest = TimedProduct::new(distinct[best].product, &mut random);
    fastest.kernel = distinct[best].kernel;
    (ProductSequence { distinct, order }, fastest)
}

impl BatchResults {
    fn entries(&self) -> [(&'static str, String); 4] {
        [
            (
                "updates a second",
                format!(
                    "{}, batch {}, one thread: {:.2} ms for {:.1} MFLOP",
                    self.updates.show(1.0, 0),
                    self.batch,
                    1e3 / self.updates_per_second,
                    self.flop_per_update as f64 / 1e6,
                ),
            ),
            (
                "  fastest product",
                format!(
                    "{} GFLOP/s: {}, {}",
                    self.limit.show(1.0, 0),
                    self.limit_product,
                    self.limit_kernel
                ),
            ),
            ("  all products", format!("{} GFLOP/s", self.products.show(1.0, 0))),
            (
                "  share of the limit",
                format!(
                    "{:.2} of the fastest product's rate, {:.2} of all products' rate",
                    self.share_of_limit, self.share_of_products
                ),
            ),
        ]
    }
}

impl StageResults for LearnerResults {
    fn entries(&self) -> Vec<(&'static str, String)> {
        let two = &self.two_threads;
        let two = format!(
            "{}, batch {}, two threads: {:.2} times one",
            two.updates.show(1.0, 0),
            self.configured.batch,
            two.speedup
        );
        let mut entries = vec![("algorithm", self.algorithm.clone())];
        entries.extend(self.configured.entries());
        entries.push(("updates a second", two));
        entries.extend(self.large_batch.iter().flat_map(BatchResults::entries));
        entries.push(("rows in the replay", self.replay_rows.to_string()));
        entries
    }

    fn target_rows(&self) -> Vec<TargetRow> {
        let of = |results: &BatchResults, stage, target| TargetRow {
            stage,
            ours: format!("{:.0} updates/s", results.updates_per_second),
            limit: format!(
                "{:.0}: its products at {:.0} GFLOP/s",
                results.updates_per_second / results.share_of_limit,
                results.limit_gflops
            ),
            share: Some(results.share_of_limit),
            target,
        };
        let two = &self.two_threads;
        let small = self.configured.share_of_limit;
        let mut rows = vec![
            of(
                &self.configured,
                "learner, batch 64",
                Target::at_least(0.75, small, "0.75 of the limit"),
            ),
            TargetRow {
                stage: "learner, batch 64, two threads",
                ours: format!(
                    "{:.0} updates/s, {:.2} times one thread",
                    two.updates_per_second, two.speedup
                ),
                limit: "2 times".into(),
                share: Some(two.speedup / 2.0),
                target: Target::at_least(1.6, two.speedup, "1.6 times one thread"),
            },
        ];
        rows.extend(self.large_batch.iter().map(|large| {
            let target = Target::at_least(0.85, large.share_of_limit, "0.85 of the limit");
            of(large, "learner, batch 256", target)
        }));
        rows
    }
}
