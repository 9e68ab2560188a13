//! A vector of environments that are stepped together, with time limits, automatic resets, numbered random streams and
//! snapshots.

mod snapshot;

use shoal_base::space::{EnvironmentSpec, Space};
use shoal_base::stream::{self, Purpose, Stream};
use shoal_channel::environment::StepBlocks;

use crate::description::Description;
use crate::environment::{Drawing, Environment, EnvironmentError, RequestError, make};
use crate::frame::FrameFile;

/// The low bits of a stream's number are the episode, the bits above them the environment.
const EPISODE_BITS: u32 = 40;

/// `count` environments of one kind, each in its own episode.
///
/// All random numbers of training episode k of environment e come from part (e, k) of the stream (seed, Environment,
/// server, incarnation); those of evaluation episode k from the stream (seed, Evaluation, k, 0). So an episode does not
/// depend on what was run before it.
pub struct VectorEnvironment {
    spec: EnvironmentSpec,
    training: Stream,
    evaluation: Option<Evaluation>,
    running: Vec<Running>,
    action: Vec<f64>,
    /// Tries states before they are restored, so that a refused one changes nothing.
    scratch: Box<dyn Environment>,
    /// Where the first environment is drawn.
    frames: Option<FrameFile>,
}

struct Running {
    environment: Box<dyn Environment>,
    rng: Stream,
    steps: u32,
    next_training: u64,
    next_evaluation: u64,
    /// Whether it has run all its evaluation episodes.
    done: bool,
}

/// Evaluation episodes under way.
#[derive(Clone, Copy)]
struct Evaluation {
    seed: u64,
    /// The number after the last one.
    end: Option<u64>,
}

/// Where the environments start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Reset<'a> {
    /// Each in its next training episode. Episodes are counted from 0, across resets and automatic resets.
    Next,
    /// Environment e in training episode `episodes[e]`, below 2⁴⁰; its later episodes are counted from there.
    Episodes(&'a [u64]),
    /// Environment e in evaluation episode `first` + e. The next episode of each is the one E later, where E is the
    /// number of environments: together they run every episode from `first` on exactly once.
    Evaluation {
        /// Seed of the evaluation, not necessarily the run's.
        seed: u64,
        /// Number of the first episode.
        first: u64,
        /// The number of episodes; `None` if there is no limit. An environment that has no further episode stays in its
        /// last state, whatever the actions.
        episodes: Option<u32>,
    },
    /// Environment e in state e of E concatenated physical states. Training episodes follow.
    States(&'a [f64]),
}

impl VectorEnvironment {
    /// Makes `count` environments (below 2²⁴) from `name` and `parameters`. `seed`, `server` (the server's index) and
    /// `incarnation` select the random streams of training episodes. Call `reset` before the first `step`.
    pub fn new(
        name: &str,
        parameters: &toml::Table,
        count: u32,
        seed: u64,
        server: u64,
        incarnation: u64,
    ) -> Result<Self, EnvironmentError> {
        Self::from_factory(|| make(name, parameters), count, (seed, server, incarnation))
    }

    /// As [`new`](Self::new), for environments that `make` makes.
    ///
    /// # Errors
    /// When `make` fails.
    pub fn from_factory<E>(
        make: impl Fn() -> Result<Box<dyn Environment>, E>,
        count: u32,
        (seed, server, incarnation): (u64, u64, u64),
    ) -> Result<Self, E> {
        let scratch = make()?;
        let spec = scratch.spec();
        let training = stream::stream(seed, Purpose::Environment, server, incarnation);
        let running = |_| {
            let environment = make()?;
            Ok(Running {
                environment,
                rng: training.clone(),
                steps: 0,
                next_training: 0,
                next_evaluation: 0,
                done: false,
            })
        };
        Ok(Self {
            running: (0..count).map(running).collect::<Result<_, _>>()?,
            action: Vec::with_capacity(spec.action.width()),
            evaluation: None,
            spec,
            training,
            scratch,
            frames: None,
        })
    }

    /// Draws the first environment into this file after each reset and each step; at the end of an episode, before the
    /// next one begins.
    #[must_use]
    pub fn drawn_into(self, frames: Option<FrameFile>) -> Self {
        Self { frames, ..self }
    }

    /// The first environment's current state, with this action.
    pub fn draw(&self, action: &[f32]) -> Option<Drawing> {
        let action: Vec<f64> = action.iter().map(|a| f64::from(*a)).collect();
        self.running.first()?.environment.draw(&action)
    }

    /// The meaning of each environment's numbers.
    pub fn describe(&self) -> Description {
        Description::of(&*self.scratch)
    }

    /// Spaces and time limit of each environment.
    pub fn spec(&self) -> &EnvironmentSpec {
        &self.spec
    }

    /// The number of environments, E.
    pub fn count(&self) -> usize {
        self.running.len()
    }

    /// Starts an episode in every environment and writes the E first observations.
    ///
    /// A wrong count changes nothing. After a refused state the episodes are undefined until the next successful reset.
    /// Panics unless `observations` has E × observation width numbers.
    pub fn reset(&mut self, start: Reset<'_>, observations: &mut [f32]) -> Result<(), RequestError> {
        let count = self.running.len();
        assert_eq!(
            observations.len(),
            count * self.spec.observation.width(),
            "length of `observations`"
        );
        self.evaluation = match start {
            Reset::Evaluation { seed, first, episodes } => {
                for (number, running) in (first..).zip(&mut self.running) {
                    running.next_evaluation = number;
                }
                let end = episodes.map(|episodes| first.saturating_add(episodes.into()));
                Some(Evaluation { seed, end })
            }
            Reset::Episodes(episodes) => {
                if episodes.len() != count {
                    return Err(wrong_count("episodes", episodes.len(), count, "one each".to_owned()));
                }
                for (running, &episode) in self.running.iter_mut().zip(episodes) {
                    running.next_training = episode;
                }
                None
            }
            Reset::States(states) if count == 0 || !states.len().is_multiple_of(count) => {
                return Err(wrong_count("states", states.len(), count, "one state each".to_owned()));
            }
            Reset::Next | Reset::States(_) => None,
        };
        let width = self.spec.observation.width();
        for (e, observation) in observations.chunks_exact_mut(width).enumerate() {
            self.begin_episode(e);
            if let Reset::States(states) = start {
                let width = states.len() / count;
                self.running[e].environment.reset_to(&states[e * width..][..width])?;
            }
            self.running[e].environment.observe(observation);
        }
        if let (Some(frames), Some(Running { environment, .. })) = (&self.frames, self.running.first()) {
            frames.write(|| environment.draw(&[]), per_second(environment.as_ref()));
        }
        Ok(())
    }

    /// Steps each environment with its action (E actions, concatenated), and starts the next episode where one has
    /// ended.
    ///
    /// An action that is NaN, infinite or not an index of a discrete action is refused and changes nothing: clipping
    /// would hide that a policy diverges. The environment clips a finite action outside its box. Panics unless the
    /// slices of `out` have the lengths that `StepBlocks` gives them.
    pub fn step(&mut self, actions: &[f32], out: StepBlocks<'_>) -> Result<(), RequestError> {
        self.check(actions)?;
        let width = self.spec.observation.width();
        let StepBlocks {
            observations,
            next_observations,
            rewards,
            terminated,
            truncated,
        } = out;
        let count = self.running.len();
        assert_eq!(
            [observations.len(), next_observations.len()],
            [count * width; 2],
            "lengths of observations"
        );
        assert_eq!(
            [rewards.len(), terminated.len(), truncated.len()],
            [count; 3],
            "lengths of rewards and flags"
        );
        for (e, action) in actions.chunks_exact(self.spec.action.width()).enumerate() {
            let running = &mut self.running[e];
            if running.done {
                [rewards[e], terminated[e], truncated[e]] = [0.0; 3];
                running
                    .environment
                    .observe(&mut next_observations[e * width..][..width]);
                running.environment.observe(&mut observations[e * width..][..width]);
                continue;
            }
            self.action.clear();
            self.action.extend(action.iter().map(|a| f64::from(*a)));
            let step = running.environment.step(&self.action, &mut running.rng);
            running.steps += 1;
            let out_of_time = !step.terminated && running.steps >= self.spec.time_limit;
            rewards[e] = step.reward as f32;
            terminated[e] = f32::from(u8::from(step.terminated));
            truncated[e] = f32::from(u8::from(out_of_time));
            if let (0, Some(frames)) = (e, &self.frames) {
                let environment = running.environment.as_ref();
                frames.write(|| environment.draw(&self.action), per_second(environment));
            }
            let next_observation = &mut next_observations[e * width..][..width];
            running.environment.observe(next_observation);
            let observation = &mut observations[e * width..][..width];
            if step.terminated || out_of_time {
                self.begin_episode(e);
                self.running[e].environment.observe(observation);
            } else {
                observation.copy_from_slice(next_observation);
            }
        }
        Ok(())
    }

    /// Starts the next episode of environment `e`.
    fn begin_episode(&mut self, e: usize) {
        let stride = self.running.len() as u64;
        let running = &mut self.running[e];
        running.done = false;
        match self.evaluation {
            Some(Evaluation { end: Some(end), .. }) if running.next_evaluation >= end => {
                running.done = true;
                return;
            }
            Some(Evaluation { seed, .. }) => {
                running.rng = stream::stream(seed, Purpose::Evaluation, running.next_evaluation, 0);
                running.next_evaluation = running.next_evaluation.wrapping_add(stride);
            }
            None => {
                running.rng = training_stream(&self.training, e, running.next_training);
                running.next_training += 1;
            }
        }
        running.steps = 0;
        running.environment.reset(&mut running.rng);
    }

    fn check(&self, actions: &[f32]) -> Result<(), RequestError> {
        let (count, width) = (self.running.len(), self.spec.action.width());
        if actions.len() != count * width {
            return Err(wrong_count("actions", actions.len(), count, format!("{width} each")));
        }
        let refused = |action: &f32| match self.spec.action {
            Space::Box { .. } => !action.is_finite(),
            Space::Discrete { n, .. } => action.fract() != 0.0 || !(0.0..n as f32).contains(action),
        };
        match actions.iter().position(refused) {
            Some(i) => Err(RequestError::Action {
                environment: i / width,
                action: actions[i],
            }),
            None => Ok(()),
        }
    }
}

/// Steps in a second of the environment's time.
fn per_second(environment: &dyn Environment) -> Option<f64> {
    environment.time_step().map(f64::recip)
}

/// Stream (e, episode) of a server's environments.
fn training_stream(server: &Stream, e: usize, episode: u64) -> Stream {
    let mut stream = server.clone();
    stream.set_stream((e as u64) << EPISODE_BITS | episode);
    stream
}

fn wrong_count(what: &'static str, given: usize, environments: usize, expected: String) -> RequestError {
    RequestError::Count {
        what,
        given,
        environments,
        expected,
    }
}

#[cfg(test)]
mod tests;
