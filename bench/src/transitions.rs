//! The rate of rows from an actor's process into the committed replay of a learner's process, and from there into
//! minibatches. The learner is the ordinary role, configured to make no gradient steps. This process is the actor.

use std::time::{Duration, Instant};

use serde::Serialize;
use shoal_common::channel::transitions::ChunkSender;
use shoal_common::channel::{Domain, EventName, Listener, Notifier, wait_for};
use shoal_common::config::Config;
use shoal_common::exit::Exit;
use shoal_common::role::Role;
use shoal_common::run_dir::RunDir;
use shoal_learner::algorithms::minibatch::Minibatch;
use shoal_learner::algorithms::sampling::Sampler;
use shoal_learner::replay::Replay;
use shoal_run::child_process::ChildProcess;

use super::intervals::{self, Samples};
use super::measurement::{StageResults, TimeBudget};
use super::progress::wait_for_replay;
use super::rows::{ENVIRONMENTS, Rows};
use super::target::{Target, TargetRow};
use super::temporary_run::{TemporaryRun, UNDISTURBED, ddpg};

const INTERVAL: Duration = Duration::from_millis(100);
const SAMPLING_INTERVAL: Duration = Duration::from_millis(20);

/// Shares of the time: warming up (the first access to the replay's pages), moving rows, and sampling them.
const SHARES: [f64; 3] = [0.15, 0.65, 0.2];

/// Number of different chunks that are sent in turn.
const CHUNKS: usize = 64;

/// The fields of `bench transitions --json`.
#[derive(Serialize)]
pub(super) struct TransitionResults {
    rows_per_second: f64,
    chunk_rows: usize,
    /// Rows drawn at random from the replay and copied into minibatches, by one thread, while no process writes.
    sampled_rows_per_second: f64,
    row_bytes: usize,
    window_chunks: u32,
    replay_rows: u64,
    batch: usize,
    #[serde(skip)]
    moved: Samples,
    #[serde(skip)]
    sampled: Samples,
}

pub(super) fn measure(budget: &TimeBudget) -> anyhow::Result<TransitionResults> {
    let own = ["actors.chunk_steps=64", "replay.updates_per_step=0"];
    let temporary = TemporaryRun::new(&[&own[..], &UNDISTURBED].concat())?;
    let moved = temporary.with_role(Role::Learner, |domain, learner| {
        move_rows(&temporary.config, &temporary.run, domain, learner, budget)
    })?;
    let replay = Replay::open(&temporary.run.replay_file(), &temporary.replay_layout())?;
    let sampled = sample(&replay, &temporary.config, budget)?;
    Ok(TransitionResults {
        rows_per_second: moved.median(),
        chunk_rows: temporary.config.chunk_rows(),
        sampled_rows_per_second: sampled.median(),
        row_bytes: size_of::<f32>() * temporary.config.row_layout().width(),
        window_chunks: temporary.config.actors.window,
        replay_rows: replay.rows().end - replay.rows().start,
        batch: ddpg(&temporary.config)?.batch,
        moved,
        sampled,
    })
}

/// Sends chunks as fast as the window allows and returns the rates of committed rows.
fn move_rows(
    config: &Config,
    run: &RunDir,
    domain: &Domain,
    learner: &mut ChildProcess,
    budget: &TimeBudget,
) -> anyhow::Result<Samples> {
    let row = config.row_layout();
    let mut rows = Rows::new(config)?;
    let mut chunks = vec![vec![0.0; ENVIRONMENTS * row.width()]; CHUNKS];
    chunks.iter_mut().try_for_each(|chunk| rows.fill(chunk))?;

    let listener = Listener::bind(domain, EventName(Role::Actor, 0))?;
    let notifier = Notifier::new(domain, EventName(Role::Learner, 0))?;
    let commits = wait_for_replay(&run.replay_file(), || {
        learner.check()?;
        budget.check()
    })?;
    let handshake = ChunkSender::open(domain, 0, 1, config.chunk_layout(), config.actors.window)?;
    let waited = handshake.wait(&commits, &listener, &budget.stop, || {
        // Once the learner has ended, nothing is committed any more.
        if learner.check().is_err() {
            budget.stop.request();
        }
    });
    if let Err(Exit::Stopped) = waited {
        learner.check()?;
    }
    let mut sender = waited.map_err(super::measurement::interrupted)?;

    let [warm_up, moving, _] = SHARES;
    let mut results = Samples::default();
    let mut left = intervals::count(budget.length, moving, INTERVAL);
    let (mut begun, mut length, mut committed) = (Instant::now(), budget.length.mul_f64(warm_up), None);
    loop {
        for numbers in &chunks {
            let may_send = || sender.in_flight(commits.committed(0)) < u64::from(config.actors.window);
            let waited = wait_for(
                &listener,
                &budget.stop,
                || Ok(may_send().then_some(())),
                || {
                    // Once the learner has ended, nothing is committed any more.
                    if learner.check().is_err() {
                        budget.stop.request();
                    }
                    sender.refresh_connections()
                },
            );
            if let Err(Exit::Stopped) = waited {
                learner.check()?;
            }
            waited.map_err(super::measurement::interrupted)?;
            let mut chunk = sender.empty_chunk()?;
            for numbers in numbers.chunks_exact(row.width()) {
                chunk.push(&row.read(numbers));
            }
            sender.send(chunk, 0)?;
            notifier.notify();
        }
        let elapsed = begun.elapsed();
        if elapsed >= length {
            let now = commits.rows();
            // The first interval is the warm-up.
            if let Some(before) = committed.replace(now) {
                results.add((now - before) as f64 / elapsed.as_secs_f64());
                left -= 1;
                if left == 0 {
                    return Ok(results);
                }
            }
            budget.check()?;
            (begun, length) = (Instant::now(), INTERVAL);
        }
    }
}

/// The rates of rows drawn into minibatches, as the learner does it.
fn sample(replay: &Replay, config: &Config, budget: &TimeBudget) -> anyhow::Result<Samples> {
    let sampler = Sampler::new(config.run.seed);
    let size = ddpg(config)?.batch;
    let mut batch = Minibatch::new(config.row_layout(), size);
    let mut indices = vec![0; size];
    let mut update = 0;
    let mut gather = || {
        let newest = replay.sampling_range(replay.head(), config.replay.capacity);
        sampler.indices(update, newest.clone(), &mut indices);
        update += 1;
        batch.gather(replay, &indices, &newest);
        std::hint::black_box(&mut batch);
    };
    // Warms up: the first access to each page of the new mapping is a page fault.
    intervals::rate(budget.length.mul_f64(SHARES[2] / 4.0), &mut gather);
    let mut results = Samples::default();
    for _ in 0..intervals::count(budget.length, SHARES[2], SAMPLING_INTERVAL) {
        budget.check()?;
        results.add(intervals::rate(SAMPLING_INTERVAL, &mut gather) * size as f64);
    }
    Ok(results)
}

impl StageResults for TransitionResults {
    fn target_rows(&self) -> Vec<TargetRow> {
        let row = |stage, rows: f64, target| TargetRow {
            stage,
            ours: format!("{:.1} million rows/s", rows / 1e6),
            limit: String::new(),
            share: None,
            target,
        };
        let [moved, sampled] = [self.rows_per_second, self.sampled_rows_per_second];
        vec![
            row(
                "transitions into the replay",
                moved,
                Target::at_least(5e6, moved, "5 million rows/s"),
            ),
            row(
                "transitions sampled",
                sampled,
                Target::at_least(20e6, sampled, "20 million rows/s"),
            ),
        ]
    }

    fn entries(&self) -> Vec<(&'static str, String)> {
        vec![
            (
                "into the committed replay",
                format!("{} million rows a second", self.moved.show(1e6, 2)),
            ),
            (
                "sampled into minibatches",
                format!(
                    "{} million rows a second, batch {}",
                    self.sampled.show(1e6, 2),
                    self.batch
                ),
            ),
            (
                "rows",
                format!(
                    "{} bytes, {} in a chunk, {} chunks in the window, {} in the replay",
                    self.row_bytes, self.chunk_rows, self.window_chunks, self.replay_rows
                ),
            ),
        ]
    }
}
