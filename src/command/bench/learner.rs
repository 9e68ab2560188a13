//! How many updates a second the learner makes, and how much of the machine's matrix products that is.

use std::time::Duration;

use anyhow::Context;
use serde::Serialize;
use shoal_common::commit::ChunkMark;
use shoal_common::config::Config;
use shoal_common::stream::{Purpose, stream};
use shoal_learner::algorithm::Algorithm;
use shoal_learner::ddpg::Ddpg;
use shoal_learner::product::products_of_update;
use shoal_learner::replay::Replay;
use shoal_learner::replayed_ddpg::ReplayedDdpg;

use super::product::Multiplication;
use super::rows::{ENVIRONMENTS, Rows};
use super::scene::{Scene, ddpg};
use super::window::{self, Windows};
use super::{Figures, Patience};

const WINDOW: Duration = Duration::from_millis(100);

/// Updates, the fastest product and all products take turns: each gets a third of the time.
const SHARE: f64 = 1.0 / 3.0;

/// Attempts at each shape by each kernel, of which the best counts when the kernels and shapes are compared.
const ATTEMPTS: usize = 10;

/// Part of the time that goes before: until Adam's moments and the caches are as they stay.
const WARM_UP: f64 = 0.1;

/// The fields of `bench learner --json`.
#[derive(Serialize)]
pub(super) struct LearnerFigures {
    updates_per_second: f64,
    /// Of the matrix products alone.
    flop_per_update: u64,
    /// The fastest of the update's own products, by the fastest kernel.
    limit_gflops: f64,
    share_of_limit: f64,
    limit_product: String,
    limit_kernel: &'static str,
    /// All products of an update one after the other, each by its fastest kernel, small ones and all.
    products_gflops: f64,
    share_of_products: f64,
    batch: usize,
    replay_rows: u64,
    threads: u32,
    #[serde(skip)]
    updates: Windows,
    #[serde(skip)]
    limit: Windows,
    #[serde(skip)]
    products: Windows,
}

pub(super) fn measure(patience: &Patience) -> anyhow::Result<LearnerFigures> {
    let scene = Scene::new(&[])?;
    let replay = Replay::create(&scene.run.replay_file(), &scene.replay_layout())?;
    // Mapped as ever, and gone from the directory whatever becomes of this process.
    let config = scene.remove_directory()?;
    let mut learner = Learner::new(&config, replay, patience)?;
    let (mut list, mut fastest) = multiplications(&config, &learner.method.ddpg, learner.batch);

    window::rate(patience.length.mul_f64(WARM_UP), || learner.update());
    let (mut updates, mut limit, mut products) = (Windows::default(), Windows::default(), Windows::default());
    let flop = learner.method.ddpg.flop_per_update();
    for _ in 0..window::count(patience.length, SHARE, WINDOW) {
        patience.check()?;
        updates.add(window::rate(WINDOW, || learner.update()));
        limit.add(fastest.gflops(WINDOW));
        products.add(window::rate(WINDOW, || list.multiply_all()) * flop as f64 / 1e9);
    }

    let achieved = flop as f64 * updates.median() / 1e9;
    Ok(LearnerFigures {
        updates_per_second: updates.median(),
        flop_per_update: flop,
        limit_gflops: limit.median(),
        share_of_limit: achieved / limit.median(),
        limit_product: fastest.shape(),
        limit_kernel: fastest.kernel.name(),
        products_gflops: products.median(),
        share_of_products: achieved / products.median(),
        batch: learner.batch,
        replay_rows: learner.replay.head(),
        threads: 1,
        updates,
        limit,
        products,
    })
}

/// What a learner updates with, as in its loop.
struct Learner {
    method: ReplayedDdpg,
    batch: usize,
    replay: Replay,
}

impl Learner {
    /// New networks, and a replay that is filled to its capacity.
    fn new(config: &Config, mut replay: Replay, patience: &Patience) -> anyhow::Result<Self> {
        let row = config.row_layout();
        let mut rows = Rows::new(config)?;
        let mut chunk = vec![0.0; ENVIRONMENTS * row.width()];
        for sequence in 1..=config.replay.capacity / ENVIRONMENTS as u64 {
            patience.check()?;
            rows.fill(&mut chunk)?;
            let mark = ChunkMark {
                incarnation: 1,
                sequence,
            };
            replay.append_and_commit(0, mark, &chunk).context("the replay")?;
        }
        let ddpg = ddpg(config)?;
        Ok(Self {
            method: ReplayedDdpg::new(&config.spec, ddpg, config.run.seed, config.replay.capacity)?,
            batch: ddpg.batch,
            replay,
        })
    }

    fn update(&mut self) {
        std::hint::black_box(self.method.update(&self.replay, self.replay.head()));
    }
}

/// An update's products in their order; a shape that comes again uses the same numbers.
struct List {
    distinct: Vec<Multiplication>,
    order: Vec<usize>,
}

impl List {
    fn multiply_all(&mut self) {
        for &i in &self.order {
            self.distinct[i].multiply();
        }
    }
}

/// All products of an update, each with its best kernel, and the fastest of them once more.
fn multiplications(config: &Config, ddpg: &Ddpg, batch: usize) -> (List, Multiplication) {
    let mut random = stream(config.run.seed, Purpose::Exploration, 1, 0);
    let (mut distinct, mut order): (Vec<Multiplication>, Vec<usize>) = Default::default();
    for product in products_of_update(ddpg.policy_layout(), ddpg.critic_layout(), batch) {
        let known = distinct.iter().position(|known| known.product == product);
        order.push(known.unwrap_or(distinct.len()));
        if known.is_none() {
            distinct.push(Multiplication::new(product, &mut random));
        }
    }
    // In turn, so that a disturbance does not meet all attempts at one shape.
    for _ in 0..ATTEMPTS {
        distinct.iter_mut().for_each(Multiplication::try_kernels);
    }
    let best = (0..distinct.len()).fold(0, |best, i| {
        if distinct[i].best > distinct[best].best {
            i
        } else {
            best
        }
    });
    let mut fastest = Multiplication::new(distinct[best].product, &mut random);
    fastest.kernel = distinct[best].kernel;
    (List { distinct, order }, fastest)
}

impl Figures for LearnerFigures {
    fn lines(&self) -> Vec<(&'static str, String)> {
        vec![
            ("updates a second", self.updates.show(1.0, 0)),
            (
                "an update",
                format!(
                    "{:.2} ms for {:.1} MFLOP, batch {}, {} rows in the replay, one thread",
                    1e3 / self.updates_per_second,
                    self.flop_per_update as f64 / 1e6,
                    self.batch,
                    self.replay_rows
                ),
            ),
            (
                "its fastest product",
                format!(
                    "{} GFLOP/s: {}, {}",
                    self.limit.show(1.0, 0),
                    self.limit_product,
                    self.limit_kernel
                ),
            ),
            ("all its products", format!("{} GFLOP/s", self.products.show(1.0, 0))),
            (
                "share of the limit",
                format!(
                    "{:.2} of the fastest product's rate, {:.2} of all products' rate",
                    self.share_of_limit, self.share_of_products
                ),
            ),
        ]
    }
}
