//! The algorithms other than DDPG as plain single-process programs, with one environment and the same random streams.

use shoal_actor::exploration::{Exploration, StepCounts};
use shoal_common::channel::environment::ResponseLayout;
use shoal_common::config::{AlgorithmConfig, Config};
use shoal_common::stream::{Purpose, stream};
use shoal_common::transition::Transition;
use shoal_env_server::environment::frozen_lake::{ACTIONS, STATES};
use shoal_env_server::vector::{Reset, VectorEnvironment};
use shoal_learner::algorithms::minibatch::Minibatch;
use shoal_learner::algorithms::minibatch_algorithm::MinibatchAlgorithm;
use shoal_learner::algorithms::registry;
use shoal_learner::algorithms::sampling::Sampler;
use shoal_learner::networks::digest::sha256;
use shoal_learner::replay::{ChunkId, Replay, ReplayLayout};

/// An environment, and the exploration that chooses actions in it.
struct World {
    environment: VectorEnvironment,
    exploration: Exploration,
    response: Vec<f32>,
    /// Actions chosen so far.
    t: u64,
    /// The current state; after the end of an episode, the first state of the next one.
    s: Vec<f32>,
}

type Act = fn(&mut Exploration, &[f32], &[f32], StepCounts, &mut [f32]);

/// The result of an action.
struct Step {
    s: Vec<f32>,
    a: Vec<f32>,
    r: f32,
    s_next: Vec<f32>,
    terminated: bool,
    truncated: bool,
}

impl World {
    fn new(config: &Config) -> Self {
        let (seed, Config { environment, spec, .. }) = (config.run.seed, config);
        let streams = stream(seed, Purpose::Exploration, 0, 0);
        let mut world = Self {
            environment: VectorEnvironment::new(&environment.name, &environment.parameters, 1, seed, 0, 0).unwrap(),
            exploration: Exploration::new(config.behaviour(1).unwrap(), 1, streams),
            response: vec![0.0; ResponseLayout::new(1, spec.observation.width()).len()],
            t: 0,
            s: vec![0.0; spec.observation.width()],
        };
        world.environment.reset(Reset::Next, &mut world.s).unwrap();
        world
    }

    fn choose(&mut self, parameters: &[f32]) -> f32 {
        let mut a = [f32::NAN];
        self.choose_all(Exploration::act, self.t, parameters, &mut a);
        a[0]
    }

    /// Chooses every element of an action by a policy that was learned from `env_steps` steps.
    fn choose_all(&mut self, act: Act, env_steps: u64, parameters: &[f32], a: &mut [f32]) {
        let progress = StepCounts {
            step: self.t,
            env_steps,
        };
        act(&mut self.exploration, parameters, &self.s, progress, a);
        self.t += 1;
    }

    fn step(&mut self, a: f32) -> Step {
        self.step_all(&[a])
    }

    fn step_all(&mut self, a: &[f32]) -> Step {
        let layout = ResponseLayout::new(1, self.s.len());
        self.environment.step(a, layout.split_mut(&mut self.response)).unwrap();
        let after = layout.split_mut(&mut self.response);
        let step = Step {
            s: self.s.clone(),
            a: a.to_vec(),
            r: after.rewards[0],
            s_next: after.next_observations.to_vec(),
            terminated: after.terminated[0] != 0.0,
            truncated: after.truncated[0] != 0.0,
        };
        self.s.copy_from_slice(after.observations);
        step
    }
}

/// SARSA or Q-learning. Returns the SHA-256 of the final table, the number of truncated episodes, and the number of
/// values that are no longer 0.
pub(crate) fn tabular(config: &Config) -> (String, u64, usize) {
    let (AlgorithmConfig::QLearning(settings) | AlgorithmConfig::Sarsa(settings)) = &config.algorithm else {
        panic!("this twin is for tabular algorithms")
    };
    let (alpha, gamma) = (settings.alpha as f32, settings.gamma as f32);
    let mut q = [0.0_f32; STATES * ACTIONS];
    let mut truncated = 0;
    let mut world = World::new(config);
    for _ in 0..config.run.episodes.unwrap() {
        let mut a = world.choose(&q);
        loop {
            let step = world.step(a);
            let at = step.s[0] as usize * ACTIONS + a as usize;
            let next = step.s_next[0] as usize * ACTIONS;
            let over = step.terminated || step.truncated;
            let target = if let AlgorithmConfig::QLearning(_) = config.algorithm {
                let greatest = q[next..][..ACTIONS].iter().copied().fold(f32::MIN, f32::max);
                Some(step.r + if step.terminated { 0.0 } else { gamma * greatest })
            } else if step.terminated {
                Some(step.r)
            } else if step.truncated {
                // There is no a' to learn from.
                None
            } else {
                a = world.choose(&q);
                Some(step.r + gamma * q[next + a as usize])
            };
            if let Some(target) = target {
                q[at] += alpha * (target - q[at]);
            }
            if over {
                truncated += u64::from(step.truncated);
                break;
            }
            if let AlgorithmConfig::QLearning(_) = config.algorithm {
                a = world.choose(&q);
            }
        }
    }
    (sha256(&[&q]), truncated, q.iter().filter(|q| **q != 0.0).count())
}

/// REINFORCE: plays an episode with the current policy, then updates it. Returns the SHA-256 of the final weights.
pub(crate) fn reinforce(config: &Config) -> String {
    let place = tempfile::tempdir().unwrap();
    let chunk = config.chunk_layout();
    let mut algorithm = registry::new(config).unwrap();
    let layout = ReplayLayout {
        row: chunk.row,
        ring: config.replay.capacity,
        actors: 1,
        actor_snapshot_words: 0,
        fingerprint: 0,
    };
    let mut replay = Replay::create(&place.path().join("replay"), &layout).unwrap();
    let mut world = World::new(config);
    for number in 0..config.run.episodes.unwrap() {
        let (mut episode, mut over) = (Vec::new(), false);
        while !over {
            let a = world.choose(&algorithm.policy());
            let step = world.step(a);
            over = step.terminated || step.truncated;
            let mut row = vec![0.0; chunk.row.width()];
            let discount = if step.terminated {
                0.0
            } else {
                config.algorithm.gamma() as f32
            };
            let transition = Transition {
                s: &step.s,
                a: &step.a,
                r: step.r,
                discount,
                s_next: &step.s_next,
                last: over,
            };
            chunk.row.write(&transition, &mut row);
            episode.extend(row);
        }
        let id = ChunkId {
            incarnation: 0,
            sequence: number + 1,
        };
        replay.append_and_commit(0, id, &episode).unwrap();
        algorithm.update(&replay, replay.head());
    }
    let weight_names = registry::weight_names(config);
    let state = algorithm.state();
    let learned = state.iter().filter(|(name, _)| weight_names.contains(name));
    sha256(&learned.map(|(_, numbers)| *numbers).collect::<Vec<_>>())
}

/// An algorithm that learns from minibatches: a step, then the updates that it allows. Returns the SHA-256 of the final
/// weights.
pub(crate) fn of_minibatches<A: MinibatchAlgorithm>(config: &Config, mut algorithm: A) -> String {
    let row = config.row_layout();
    let size = config.algorithm.settings().batch();
    let (sampler, mut batch, mut indices) = (Sampler::new(config.run.seed), Minibatch::new(row, size), vec![0; size]);
    let mut rows: Vec<Vec<f32>> = Vec::new();
    let mut world = World::new(config);
    let mut a = vec![f32::NAN; row.action_width()];
    // The steps of the current episode, and how many of them have a row.
    let (mut episode, mut begun) = (Vec::new(), 0);
    let n = config.replay.n_step as usize;
    while (rows.len() as u64) < config.run.steps {
        let act: Act = if algorithm.updates() == 0 {
            Exploration::warmup
        } else {
            Exploration::act
        };
        world.choose_all(act, rows.len() as u64, algorithm.policy(), &mut a);
        episode.push(world.step_all(&a));
        let over = episode.last().is_some_and(|step| step.terminated || step.truncated);
        // A row follows as soon as n steps are known, or the episode is over.
        while begun < episode.len() && (episode.len() - begun >= n || over) {
            rows.push(row_of(config, &episode[begun..]));
            begun += 1;
            let t = rows.len() as u64;
            let beyond_warmup = t.saturating_sub(config.replay.warmup);
            let allowed = (beyond_warmup as f64 * config.replay.updates_per_step).floor() as u64;
            while algorithm.updates() < allowed {
                let window = t.saturating_sub(config.replay.capacity)..t;
                sampler.indices(algorithm.updates(), window, &mut indices);
                for (column, index) in indices.iter().enumerate() {
                    batch.set(column, &row.read(&rows[*index as usize]));
                }
                algorithm.gradient_step(&batch);
            }
        }
        if over {
            world.exploration.begin_episode(0);
            (episode, begun) = (Vec::new(), 0);
        }
    }
    let weight_names = registry::weight_names(config);
    let state = algorithm.state();
    let learned = state.iter().filter(|(name, _)| weight_names.contains(name));
    sha256(&learned.map(|(_, numbers)| *numbers).collect::<Vec<_>>())
}

/// The transition over these steps.
fn row_of(config: &Config, steps: &[Step]) -> Vec<f32> {
    let (first, end) = (&steps[0], &steps[steps.len() - 1]);
    let gamma = config.algorithm.gamma() as f32;
    let (mut r, mut discount) = (0.0, 1.0);
    for step in steps {
        r += discount * step.r;
        discount *= if step.terminated { 0.0 } else { gamma };
    }
    let transition = Transition {
        s: &first.s,
        a: &first.a,
        r,
        discount,
        s_next: &end.s_next,
        last: first.terminated || first.truncated,
    };
    let layout = config.row_layout();
    let mut row = vec![0.0; layout.width()];
    layout.write(&transition, &mut row);
    row
}
