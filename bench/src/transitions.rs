//! How fast rows get from an actor's process into the committed replay of a learner's process, and from there into
//! minibatches. The learner is the role as a run has it, told to make no updates; this process is the actor.

use std::time::{Duration, Instant};

use serde::Serialize;
use shoal_common::channel::transitions::ChunkSender;
use shoal_common::channel::{Domain, EventName, Listener, Notifier, wait_for};
use shoal_common::commit::{CommitReader, OpenError};
use shoal_common::config::Config;
use shoal_common::exit::Exit;
use shoal_common::report::Role;
use shoal_common::run_dir::RunDir;
use shoal_learner::algorithms::minibatch::Minibatch;
use shoal_learner::algorithms::sampling::Sampler;
use shoal_learner::replay::Replay;
use shoal_run::process::Peer;

use super::measurement::{Figures, Patience};
use super::rows::{ENVIRONMENTS, Rows};
use super::scene::{Scene, ddpg};
use super::target::{Line, Target};
use super::window::{self, Windows};

const WINDOW: Duration = Duration::from_millis(100);
const SAMPLING_WINDOW: Duration = Duration::from_millis(20);

/// What part of the time goes to warming up (the replay's pages are touched for the first time), to moving rows, and to
/// sampling them.
const SHARES: [f64; 3] = [0.15, 0.65, 0.2];

/// Chunks with different rows that are sent in turn.
const CHUNKS: usize = 64;

/// The fields of `bench transitions --json`.
#[derive(Serialize)]
pub(super) struct TransitionFigures {
    rows_per_second: f64,
    chunk_rows: usize,
    /// Drawn at random from the replay and copied into minibatches, by one thread, with nobody writing.
    sampled_rows_per_second: f64,
    row_bytes: usize,
    window_chunks: u32,
    replay_rows: u64,
    batch: usize,
    #[serde(skip)]
    moved: Windows,
    #[serde(skip)]
    sampled: Windows,
}

pub(super) fn measure(patience: &Patience) -> anyhow::Result<TransitionFigures> {
    let scene = Scene::new(&[
        "actors.chunk_steps=64",
        "replay.updates_per_step=0",
        "run.steps=1_000_000_000_000",
        // A checkpoint has the disk brought up to date: another stage's work.
        "checkpoint.every_seconds=86_400",
    ])?;
    let moved = scene.with_peer(Role::Learner, |domain, learner| {
        move_rows(&scene.config, &scene.run, domain, learner, patience)
    })?;
    let replay = Replay::open(&scene.run.replay_file(), &scene.replay_layout())?;
    let sampled = sample(&replay, &scene.config, patience)?;
    Ok(TransitionFigures {
        rows_per_second: moved.median(),
        chunk_rows: scene.config.chunk_rows(),
        sampled_rows_per_second: sampled.median(),
        row_bytes: size_of::<f32>() * scene.config.row_layout().width(),
        window_chunks: scene.config.actors.window,
        replay_rows: replay.rows().end - replay.rows().start,
        batch: ddpg(&scene.config)?.batch,
        moved,
        sampled,
    })
}

/// Sends chunks as fast as the window allows; rows committed a second.
fn move_rows(
    config: &Config,
    run: &RunDir,
    domain: &Domain,
    learner: &mut Peer,
    patience: &Patience,
) -> anyhow::Result<Windows> {
    let row = config.row_layout();
    let mut rows = Rows::new(config)?;
    let mut chunks = vec![vec![0.0; ENVIRONMENTS * row.width()]; CHUNKS];
    chunks.iter_mut().try_for_each(|chunk| rows.fill(chunk))?;

    let listener = Listener::bind(domain, EventName(Role::Actor, 0))?;
    let notifier = Notifier::new(domain, EventName(Role::Learner, 0))?;
    let commits = wait_for_replay(run, &listener, learner, patience)?;
    let handshake = ChunkSender::open(domain, 0, 1, config.chunk_layout(), config.actors.window)?;
    let mut sender = handshake
        .wait(&commits, &listener, &patience.stop, || {
            // A learner that has ended commits nothing.
            if learner.check().is_err() {
                patience.stop.request();
            }
        })
        .map_err(super::measurement::interrupted)?;

    let [warm_up, moving, _] = SHARES;
    let mut windows = Windows::default();
    let mut left = window::count(patience.length, moving, WINDOW);
    let (mut begun, mut length, mut committed) = (Instant::now(), patience.length.mul_f64(warm_up), None);
    loop {
        for numbers in &chunks {
            let room = || sender.in_flight(commits.committed(0)) < u64::from(config.actors.window);
            let waited = wait_for(
                &listener,
                &patience.stop,
                || Ok(room().then_some(())),
                || {
                    // A learner that has ended commits nothing more.
                    if learner.check().is_err() {
                        patience.stop.request();
                    }
                    sender.look_after()
                },
            );
            if let Err(Exit::Stopped) = waited {
                learner.check()?;
            }
            waited.map_err(super::measurement::interrupted)?;
            let mut chunk = sender.begin()?;
            for numbers in numbers.chunks_exact(row.width()) {
                chunk.push(&row.read(numbers));
            }
            sender.send(chunk, 0)?;
            notifier.notify();
        }
        let elapsed = begun.elapsed();
        if elapsed >= length {
            let now = commits.rows();
            // The first window warmed up.
            if let Some(before) = committed.replace(now) {
                windows.add((now - before) as f64 / elapsed.as_secs_f64());
                left -= 1;
                if left == 0 {
                    return Ok(windows);
                }
            }
            patience.check()?;
            (begun, length) = (Instant::now(), WINDOW);
        }
    }
}

fn wait_for_replay(
    run: &RunDir,
    listener: &Listener,
    learner: &mut Peer,
    patience: &Patience,
) -> anyhow::Result<CommitReader> {
    loop {
        match CommitReader::open(&run.replay_file()) {
            Ok(reader) => return Ok(reader),
            Err(OpenError::NotYet { .. }) => {
                learner.check()?;
                patience.check()?;
                listener.wait(Duration::from_millis(5))?;
            }
            Err(error) => return Err(error.into()),
        }
    }
}

/// Rows a second into minibatches, drawn as the learner draws them.
fn sample(replay: &Replay, config: &Config, patience: &Patience) -> anyhow::Result<Windows> {
    let sampler = Sampler::new(config.run.seed);
    let size = ddpg(config)?.batch;
    let mut batch = Minibatch::new(config.row_layout(), size);
    let mut indices = vec![0; size];
    let mut update = 0;
    let mut gather = || {
        let newest = replay.window(replay.head(), config.replay.capacity);
        sampler.indices(update, newest.clone(), &mut indices);
        update += 1;
        batch.gather(replay, &indices, &newest);
        std::hint::black_box(&mut batch);
    };
    // The mapping is new: its pages come in first.
    window::rate(patience.length.mul_f64(SHARES[2] / 4.0), &mut gather);
    let mut windows = Windows::default();
    for _ in 0..window::count(patience.length, SHARES[2], SAMPLING_WINDOW) {
        patience.check()?;
        windows.add(window::rate(SAMPLING_WINDOW, &mut gather) * size as f64);
    }
    Ok(windows)
}

impl Figures for TransitionFigures {
    fn table(&self) -> Vec<Line> {
        let line = |stage, rows: f64, target| Line {
            stage,
            ours: format!("{:.1} million rows/s", rows / 1e6),
            limit: String::new(),
            share: None,
            target,
        };
        let [moved, sampled] = [self.rows_per_second, self.sampled_rows_per_second];
        vec![
            line(
                "transitions into the replay",
                moved,
                Target::at_least(5e6, moved, "5 million rows/s"),
            ),
            line(
                "transitions sampled",
                sampled,
                Target::at_least(20e6, sampled, "20 million rows/s"),
            ),
        ]
    }

    fn lines(&self) -> Vec<(&'static str, String)> {
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
