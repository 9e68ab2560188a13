//! What each stage of an actor's and a learner's work costs, measured one by one.

use std::time::{Duration, Instant};

use anyhow::bail;
use serde::Serialize;
use shoal_actor::exploration::Exploration;
use shoal_common::channel::environment::{Begin, EnvironmentClient, ResponseLayout, Stepped};
use shoal_common::channel::transitions::ChunkSender;
use shoal_common::channel::{Domain, EventName, Listener, Notifier};
use shoal_common::commit::CommitReader;
use shoal_common::config::Config;
use shoal_common::network::{ActionRange, PolicyNetwork};
use shoal_common::report::Role;
use shoal_common::stream::{Purpose, stream};
use shoal_env_server::vector::{Start, VectorEnvironment};
use shoal_learner::algorithms::registry;
use shoal_learner::networks::initialise::initialise;
use shoal_learner::process::intake::Intake;
use shoal_learner::replay::Replay;
use shoal_run::process::Peer;

use super::measurement::{Patience, interrupted};
use super::rows::{ENVIRONMENTS, Rows};
use super::scene::{Scene, ddpg};
use super::window::{self, Windows};

/// Windows of each stage, of which the median counts.
const WINDOWS: u32 = 5;

/// What stages cost, in microseconds; a step is one of all 64 environments.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Costs {
    /// The policy alone.
    pub(super) inference_us: f64,
    /// The policy and its noise.
    pub(super) acting_us: f64,
    /// The environments alone, in the process that measures.
    pub(super) environment_step_us: f64,
    /// To the environment server's process and back, the environments' step included, where a forward pass comes before
    /// each, as an actor has it.
    pub(super) round_trip_us: f64,
    /// A chunk's rows, and sending it.
    pub(super) writing_chunk_us: f64,
    /// A chunk, from the channel into the committed replay.
    pub(super) intake_of_chunk_us: f64,
    pub(super) update_us: f64,
}

/// The policy's forward pass of one step, as an actor has it.
pub(super) struct Inference {
    policy: PolicyNetwork,
    parameters: Vec<f32>,
    observations: Vec<f32>,
    actions: Vec<f32>,
}

impl Inference {
    pub(super) fn new(config: &Config) -> anyhow::Result<Self> {
        let range = ActionRange::new(&config.spec.action)?;
        let actions = vec![0.0; ENVIRONMENTS * range.width()];
        let width = config.spec.observation.width();
        let policy = PolicyNetwork::new(width, ddpg(config)?.hidden_layers(), range, ENVIRONMENTS);
        Ok(Self {
            parameters: initialise(policy.layout(), config.run.seed, 0),
            observations: Rows::new(config)?.observations().to_vec(),
            policy,
            actions,
        })
    }

    /// One step of all environments.
    pub(super) fn step(&mut self) {
        let observations = std::hint::black_box(&self.observations);
        self.policy.forward(&self.parameters, observations, &mut self.actions);
        std::hint::black_box(&mut self.actions);
    }
}

/// Measures every stage; together they take about `length`.
pub(super) fn measure(length: Duration, patience: &Patience) -> anyhow::Result<Costs> {
    let scene = Scene::of(1, ENVIRONMENTS as u32, &[])?;
    let config = &scene.config;
    let each = length / 6;

    let mut inference = Inference::new(config)?;
    let inference_us = microseconds(each, patience, || inference.step())?;

    let stream = stream(config.run.seed, Purpose::Exploration, 0, 0);
    let mut exploration = Exploration::new(
        config.algorithm.behaviour(&config.spec, ENVIRONMENTS)?,
        ENVIRONMENTS,
        stream,
    );
    let mut step = 0;
    let acting_us = microseconds(each, patience, || {
        let Inference {
            parameters,
            observations,
            actions,
            ..
        } = &mut inference;
        exploration.act(parameters, std::hint::black_box(observations), step, actions);
        step += 1;
        std::hint::black_box(actions);
    })?;

    let environment_step_us = environment_step(config, each, patience)?;
    let round_trip_us = scene.with_peer(Role::EnvServer, |domain, server| {
        round_trip(config, domain, server, &mut inference, each, patience)
    })?;
    let mut replay = Replay::create(&scene.run.replay_file(), &scene.replay_layout())?;
    let (writing_chunk_us, intake_of_chunk_us) =
        scene.in_shared_memory(|domain| chunks(&scene, domain, &mut replay, each, patience))?;

    let mut method = registry::new(config)?;
    let head = replay.head();
    let update_us = microseconds(each, patience, || {
        std::hint::black_box(method.update(&replay, head));
    })?;
    Ok(Costs {
        inference_us,
        acting_us,
        environment_step_us,
        round_trip_us,
        writing_chunk_us,
        intake_of_chunk_us,
        update_us,
    })
}

/// Median of windows; the first part of the time warms up.
fn microseconds(length: Duration, patience: &Patience, mut work: impl FnMut()) -> anyhow::Result<f64> {
    let part = length / (WINDOWS + 1);
    window::rate(part, &mut work);
    let mut windows = Windows::default();
    for _ in 0..WINDOWS {
        patience.check()?;
        windows.add(1e6 / window::rate(part, &mut work));
    }
    Ok(windows.median())
}

fn environment_step(config: &Config, length: Duration, patience: &Patience) -> anyhow::Result<f64> {
    let (name, parameters) = (&config.environment.name, &config.environment.parameters);
    let mut environments = VectorEnvironment::new(name, parameters, config.actors.envs, config.run.seed, 0, 0)?;
    let layout = ResponseLayout::new(ENVIRONMENTS, config.spec.observation.width());
    let mut response = vec![0.0; layout.len()];
    environments.reset(Start::Next, layout.split_mut(&mut response).observations)?;
    let actions = vec![0.5; ENVIRONMENTS * config.spec.action.width()];
    let mut refused = Ok(());
    let taken = microseconds(length, patience, || {
        if let Err(error) = environments.step(&actions, layout.split_mut(&mut response)) {
            refused = Err(error);
        }
        std::hint::black_box(&mut response);
    })?;
    refused?;
    Ok(taken)
}

/// The mean over all, as it adds up in an actor's time; after a forward pass each, over which the server falls asleep.
fn round_trip(
    config: &Config,
    domain: &Domain,
    server: &mut Peer,
    inference: &mut Inference,
    length: Duration,
    patience: &Patience,
) -> anyhow::Result<f64> {
    let listener = Listener::bind(domain, EventName(Role::Actor, 0))?;
    let client = EnvironmentClient::open(domain, 0, &config.spec, ENVIRONMENTS, patience.stop.clone())?;
    client.describe(&listener, || ()).map_err(interrupted)?;
    client.reset(&listener, Begin::Next, || ()).map_err(interrupted)?;
    let actions = vec![0.5; ENVIRONMENTS * config.spec.action.width()];
    let part = length / (WINDOWS + 1);
    let mut windows = Windows::default();
    for window in 0..=WINDOWS {
        patience.check()?;
        server.check()?;
        let (begun, mut asked, mut taken) = (Instant::now(), 0.0, Duration::ZERO);
        while asked == 0.0 || begun.elapsed() < part {
            inference.step();
            let before = Instant::now();
            if let Stepped::Lost = client.step(&listener, &actions, || ()).map_err(interrupted)? {
                bail!("the environment server gave up its episodes");
            }
            taken += before.elapsed();
            asked += 1.0;
        }
        // The first one warms up.
        if window > 0 {
            windows.add(taken.as_secs_f64() * 1e6 / asked);
        }
    }
    Ok(windows.median())
}

/// What a chunk costs its actor, and the learner: both in this process, which sends a window of chunks and then takes them
/// in, as the learner does.
fn chunks(
    scene: &Scene,
    domain: &Domain,
    replay: &mut Replay,
    length: Duration,
    patience: &Patience,
) -> anyhow::Result<(f64, f64)> {
    let config = &scene.config;
    let (row, window) = (config.row_layout(), config.actors.window);
    let mut rows = vec![0.0; config.chunk_rows() * row.width()];
    let mut source = Rows::new(config)?;
    for step in rows.chunks_exact_mut(ENVIRONMENTS * row.width()) {
        source.fill(step)?;
    }
    let listener = Listener::bind(domain, EventName(Role::Actor, 0))?;
    let learner = Notifier::new(domain, EventName(Role::Learner, 0))?;
    let mut intake = Intake::open(domain, 1, window, config.chunk_layout(), u64::MAX)?;
    let handshake = ChunkSender::open(domain, 0, 1, config.chunk_layout(), window)?;
    intake.drain(replay, window, |_| false)?;
    let commits = CommitReader::open(&scene.run.replay_file())?;
    let mut sender = handshake
        .wait(&commits, &listener, &patience.stop, || {})
        .map_err(interrupted)?;

    let (mut writing, mut taking_in) = (Windows::default(), Windows::default());
    let begun = Instant::now();
    // Until every page of the replay was touched once, they would be what is measured.
    while replay.head() < config.replay.capacity || writing.is_empty() || begun.elapsed() < length {
        patience.check()?;
        let before = Instant::now();
        for _ in 0..window {
            let mut chunk = sender.begin()?;
            rows.chunks_exact(row.width())
                .for_each(|one| chunk.push(&row.read(one)));
            sender.send(chunk, 0)?;
            learner.notify();
        }
        let between = Instant::now();
        let head = replay.head();
        intake.drain(replay, window, |_| false)?;
        // The learner counts the episodes that have ended.
        std::hint::black_box((head..replay.head()).filter(|i| row.read(replay.row(*i)).last).count());
        let after = Instant::now();
        if replay.head() != head + u64::from(window) * config.chunk_rows() as u64 {
            bail!("chunks were sent and not taken in");
        }
        if replay.head() > config.replay.capacity {
            writing.add((between - before).as_secs_f64() * 1e6 / f64::from(window));
            taking_in.add((after - between).as_secs_f64() * 1e6 / f64::from(window));
        }
    }
    Ok((writing.median(), taking_in.median()))
}
