//! What an environment is.

use shoal_base::space::EnvironmentSpec;
use shoal_base::stream::Stream;

use super::error::RequestError;
use super::signal::{Goal, Picture, Signal};

/// A controlled system with a start distribution and a reward, in physical units and `f64`.
///
/// It knows no time limit but reports one in its `spec`: whoever steps it counts, and truncates.
/// Before its first `reset`, `reset_to` or `restore` it stands in an arbitrary valid state.
pub trait Environment: Send {
    /// Spaces, time limit and the width of the state. Always the same for one environment.
    fn spec(&self) -> EnvironmentSpec;

    /// Starts an episode from the start distribution.
    fn reset(&mut self, rng: &mut Stream);

    /// Starts an episode from a physical state, or says which states it takes and stays as it was.
    fn reset_to(&mut self, state: &[f64]) -> Result<(), RequestError>;

    /// Writes the observation of the present state: `spec().observation.width()` numbers.
    fn observe(&self, observation: &mut [f32]);

    /// One step under `action`, `spec().action.width()` numbers. What lies outside a box is clipped to it, and an index
    /// beyond the last counts as the last. Never panics: a NaN gives some number or NaN.
    fn step(&mut self, action: &[f64], rng: &mut Stream) -> Step;

    /// Writes the present state: `spec().state_width` numbers from which `restore` makes the same future, bit for bit,
    /// under the same actions and random numbers. An environment that cannot say its state has width 0, and nothing to do.
    fn save(&self, _state: &mut [f64]) {}

    /// Goes on within an episode, from a state that `save` wrote for an environment made alike. What cannot be such a
    /// state is refused whatever the present one is, and that is kept. This one suits where `reset_to` knows of
    /// everything that the future depends on. (A state that a NaN action led to may be refused.)
    fn restore(&mut self, state: &[f64]) -> Result<(), RequestError> {
        self.reset_to(state)
    }

    /// What the numbers of an observation and an action mean, in the order in which people are shown them. Those that are
    /// worth watching are enough. Always the same for one environment.
    fn signals(&self) -> Vec<Signal> {
        Signal::by_number(&self.spec())
    }

    /// Δt of a step in s, where the environment has a time.
    fn time_step(&self) -> Option<f64> {
        None
    }

    /// What success is, where more can be said of it than the return says.
    fn goal(&self) -> Option<Goal> {
        None
    }

    /// What the report draws of an episode. It reads signals by their keys, so `signals` must have those.
    fn picture(&self) -> Picture {
        Picture::None
    }
}

/// What a step gave, besides the new state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Reward `r`.
    pub reward: f64,
    /// The new state is terminal: nothing comes after it.
    pub terminated: bool,
}
