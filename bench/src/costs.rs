//! The time that each stage of an actor's and a learner's work takes, measured separately.

use std::time::{Duration, Instant};

use anyhow::bail;
use serde::Serialize;
use shoal_actor::exploration::{Exploration, StepCounts};
use shoal_common::channel::environment::{EnvironmentClient, ResetRequest, ResponseLayout, StepResult};
use shoal_common::channel::transitions::ChunkSender;
use shoal_common::channel::{Domain, EventName, Listener, Notifier};
use shoal_common::commit::CommitReader;
use shoal_common::config::Config;
use shoal_common::network::{ActionRange, DeterministicPolicy};
use shoal_common::role::Role;
use shoal_common::stream::{Purpose, stream};
use shoal_env_server::vector::{Reset, VectorEnvironment};
use shoal_learner::algorithms::registry;
use shoal_learner::networks::initialise::small_output;
use shoal_learner::process::intake::Intake;
use shoal_learner::replay::Replay;
use shoal_run::child_process::ChildProcess;

use super::intervals::{self, Samples};
use super::measurement::{TimeBudget, interrupted};
use super::rows::{ENVIRONMENTS, Rows};
use super::temporary_run::{TemporaryRun, ddpg};

/// Intervals per stage; the result is the median of theirs.
const INTERVALS: u32 = 5;

/// Times of the stages in microseconds. A step is one of all 64 environments.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Costs {
    /// The policy's forward pass.
    pub(super) inference_us: f64,
    /// The forward pass and exploration noise.
    pub(super) acting_us: f64,
    /// The environments' step, in this process.
    pub(super) environment_step_us: f64,
    /// The same step through the environment server's process, with a forward pass before each request, as in an actor.
    pub(super) round_trip_us: f64,
    /// Writing a chunk's rows and sending it.
    pub(super) writing_chunk_us: f64,
    /// Moving a chunk from the channel into the committed replay.
    pub(super) intake_of_chunk_us: f64,
    /// One gradient step of critic and actor.
    pub(super) update_us: f64,
}

/// The policy's forward pass for one step of all environments, as in an actor.
pub(super) struct Inference {
    policy: DeterministicPolicy,
    parameters: Vec<f32>,
    observations: Vec<f32>,
    actions: Vec<f32>,
}

impl Inference {
    pub(super) fn new(config: &Config) -> anyhow::Result<Self> {
        let range = ActionRange::new(&config.spec.action)?;
        let actions = vec![0.0; ENVIRONMENTS * range.width()];
        let network = ddpg(config)?.networks(&config.spec).actor;
        let policy = DeterministicPolicy::new(network, range, ENVIRONMENTS);
        Ok(Self {
            parameters: small_output(policy.layout(), config.run.seed, 0),
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

/// Measures every stage, in about `length` altogether.
pub(super) fn measure(length: Duration, budget: &TimeBudget) -> anyhow::Result<Costs> {
    let temporary = TemporaryRun::of(1, ENVIRONMENTS as u32, &[])?;
    let config = &temporary.config;
    let each = length / 6;

    let mut inference = Inference::new(config)?;
    let inference_us = microseconds(each, budget, || inference.step())?;

    let stream = stream(config.run.seed, Purpose::Exploration, 0, 0);
    let mut exploration = Exploration::new(config.behaviour(ENVIRONMENTS)?, ENVIRONMENTS, stream);
    let mut step = 0;
    let acting_us = microseconds(each, budget, || {
        let Inference {
            parameters,
            observations,
            actions,
            ..
        } = &mut inference;
        let progress = StepCounts { step, env_steps: 0 };
        exploration.act(parameters, std::hint::black_box(observations), progress, actions);
        step += 1;
        std::hint::black_box(actions);
    })?;

    let environment_step_us = environment_step(config, each, budget)?;
    let round_trip_us = temporary.with_role(Role::EnvServer, |domain, server| {
        round_trip(config, domain, server, &mut inference, each, budget)
    })?;
    let mut replay = Replay::create(&temporary.run.replay_file(), &temporary.replay_layout())?;
    let (writing_chunk_us, intake_of_chunk_us) =
        temporary.in_shared_memory(|domain| chunks(&temporary, domain, &mut replay, each, budget))?;

    let mut algorithm = registry::new(config)?;
    let head = replay.head();
    let update_us = microseconds(each, budget, || {
        std::hint::black_box(algorithm.update(&replay, head));
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

/// The median time of `work` over several intervals, after a warm-up.
fn microseconds(length: Duration, budget: &TimeBudget, mut work: impl FnMut()) -> anyhow::Result<f64> {
    let part = length / (INTERVALS + 1);
    intervals::rate(part, &mut work);
    let mut results = Samples::default();
    for _ in 0..INTERVALS {
        budget.check()?;
        results.add(1e6 / intervals::rate(part, &mut work));
    }
    Ok(results.median())
}

fn environment_step(config: &Config, length: Duration, budget: &TimeBudget) -> anyhow::Result<f64> {
    let (name, parameters) = (&config.environment.name, &config.environment.parameters);
    let mut environments = VectorEnvironment::new(name, parameters, config.actors.envs, config.run.seed, 0, 0)?;
    let layout = ResponseLayout::new(ENVIRONMENTS, config.spec.observation.width());
    let mut response = vec![0.0; layout.len()];
    environments.reset(Reset::Next, layout.split_mut(&mut response).observations)?;
    let actions = vec![0.5; ENVIRONMENTS * config.spec.action.width()];
    let mut refused = Ok(());
    let taken = microseconds(length, budget, || {
        if let Err(error) = environments.step(&actions, layout.split_mut(&mut response)) {
            refused = Err(error);
        }
        std::hint::black_box(&mut response);
    })?;
    refused?;
    Ok(taken)
}

/// The mean time of a request within each interval, and the median of these. A forward pass precedes each request, so
/// the server falls asleep in between, as in a run.
fn round_trip(
    config: &Config,
    domain: &Domain,
    server: &mut ChildProcess,
    inference: &mut Inference,
    length: Duration,
    budget: &TimeBudget,
) -> anyhow::Result<f64> {
    let listener = Listener::bind(domain, EventName(Role::Actor, 0))?;
    let client = EnvironmentClient::open(domain, 0, &config.spec, ENVIRONMENTS, budget.stop.clone())?;
    client.spec(&listener, || ()).map_err(interrupted)?;
    client
        .reset(&listener, ResetRequest::Next, || ())
        .map_err(interrupted)?;
    let actions = vec![0.5; ENVIRONMENTS * config.spec.action.width()];
    let part = length / (INTERVALS + 1);
    let mut results = Samples::default();
    for interval in 0..=INTERVALS {
        budget.check()?;
        server.check()?;
        let (begun, mut asked, mut taken) = (Instant::now(), 0.0, Duration::ZERO);
        while asked == 0.0 || begun.elapsed() < part {
            inference.step();
            let before = Instant::now();
            if let StepResult::Lost = client.step(&listener, &actions, || ()).map_err(interrupted)? {
                bail!("the environment server lost its episodes");
            }
            taken += before.elapsed();
            asked += 1.0;
        }
        // The first interval is the warm-up.
        if interval > 0 {
            results.add(taken.as_secs_f64() * 1e6 / asked);
        }
    }
    Ok(results.median())
}

/// The times to send a chunk and to receive it. This process does both: it sends a window of chunks, then receives them
/// as the learner does.
fn chunks(
    temporary: &TemporaryRun,
    domain: &Domain,
    replay: &mut Replay,
    length: Duration,
    budget: &TimeBudget,
) -> anyhow::Result<(f64, f64)> {
    let config = &temporary.config;
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
    intake.take_in_turn(replay, window, |_| false)?;
    let commits = CommitReader::open(&temporary.run.replay_file())?;
    let mut sender = handshake
        .wait(&commits, &listener, &budget.stop, || {})
        .map_err(interrupted)?;

    let (mut writing, mut taking_in) = (Samples::default(), Samples::default());
    let begun = Instant::now();
    // The first pass over the replay measures page faults, so it does not count.
    while replay.head() < config.replay.capacity || writing.is_empty() || begun.elapsed() < length {
        budget.check()?;
        let before = Instant::now();
        for _ in 0..window {
            let mut chunk = sender.empty_chunk()?;
            rows.chunks_exact(row.width())
                .for_each(|one| chunk.push(&row.read(one)));
            sender.send(chunk, 0)?;
            learner.notify();
        }
        let between = Instant::now();
        let head = replay.head();
        intake.take_in_turn(replay, window, |_| false)?;
        // The learner also counts the episodes that ended.
        std::hint::black_box((head..replay.head()).filter(|i| row.read(replay.row(*i)).last).count());
        let after = Instant::now();
        if replay.head() != head + u64::from(window) * config.chunk_rows() as u64 {
            bail!("some of the chunks sent were not received");
        }
        if replay.head() > config.replay.capacity {
            writing.add((between - before).as_secs_f64() * 1e6 / f64::from(window));
            taking_in.add((after - between).as_secs_f64() * 1e6 / f64::from(window));
        }
    }
    Ok((writing.median(), taking_in.median()))
}
