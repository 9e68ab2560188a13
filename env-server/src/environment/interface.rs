//! The trait that every environment implements.

use shoal_base::space::EnvironmentSpec;
use shoal_base::stream::Stream;

use super::drawing::Drawing;
use super::error::RequestError;
use super::signal::{Goal, Picture, Signal};

/// A controlled system with a start distribution and a reward, in physical units and `f64`.
///
/// Its `spec` has a time limit, but the caller counts the steps and truncates the episode. Before the first `reset`,
/// `reset_to` or `restore` the state is arbitrary but valid.
///
/// ```
/// use shoal_base::stream::{Purpose, stream};
/// use shoal_env_server::environment::Environment;
/// use shoal_env_server::environment::pendulum::{Pendulum, PendulumParameters};
///
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let mut pendulum = Pendulum::new(PendulumParameters::default())?;
/// let mut rng = stream(1, Purpose::Environment, 0, 0);
/// pendulum.reset(&mut rng);
/// let mut observation = vec![0.0; pendulum.spec().observation.width()];
/// for _ in 0..pendulum.spec().time_limit {
///     let step = pendulum.step(&[2.0], &mut rng);
///     pendulum.observe(&mut observation); // cos θ, sin θ, angular velocity
///     assert!(step.reward <= 0.0 && !step.terminated);
///     assert!((observation[0].hypot(observation[1]) - 1.0).abs() < 1e-6);
/// }
/// # Ok(())
/// # }
/// ```
pub trait Environment: Send {
    /// Spaces, time limit and the width of the state. They never change.
    fn spec(&self) -> EnvironmentSpec;

    /// Starts an episode from the start distribution.
    fn reset(&mut self, rng: &mut Stream);

    /// Starts an episode from a physical state. On an error, which describes the valid states, nothing has changed.
    fn reset_to(&mut self, state: &[f64]) -> Result<(), RequestError>;

    /// Writes the observation of the current state: `spec().observation.width()` numbers.
    fn observe(&self, observation: &mut [f32]);

    /// Takes a step with `action`, `spec().action.width()` numbers. A number outside a box is clipped to it, and an
    /// index beyond the last counts as the last. Never panics: a NaN gives some number or NaN.
    fn step(&mut self, action: &[f64], rng: &mut Stream) -> Step;

    /// Writes the current state: `spec().state_width` numbers. After `restore` with them, the same actions and random
    /// numbers give the same future, bit for bit. An environment that cannot save its state has width 0 and keeps this
    /// default.
    fn save(&self, _state: &mut [f64]) {}

    /// Continues an episode from a state that `save` wrote for an environment with the same parameters. An invalid
    /// state is refused and changes nothing; whether it is valid does not depend on the current one. The default suits
    /// an environment whose future depends only on what `reset_to` sets. (A state that a NaN action led to may be
    /// refused.)
    fn restore(&mut self, state: &[f64]) -> Result<(), RequestError> {
        self.reset_to(state)
    }

    /// The meaning of the numbers of an observation and an action, in the order in which the user sees them. Numbers
    /// that are not worth watching can be left out. The signals never change.
    fn signals(&self) -> Vec<Signal> {
        Signal::by_number(&self.spec())
    }

    /// Δt of a step in s, if the environment has a physical time.
    fn time_step(&self) -> Option<f64> {
        None
    }

    /// The criterion of success, if there is one besides the return.
    fn goal(&self) -> Option<Goal> {
        None
    }

    /// Draws the current state, for films and the report. `action` is the action taken in this state. If that is not
    /// known yet, it is the action that led here; it is empty if there is none. An environment that does not draw
    /// itself keeps this default.
    fn draw(&self, _action: &[f64]) -> Option<Drawing> {
        None
    }

    /// What the report draws of an episode. `signals` must include all keys that the picture reads.
    fn picture(&self) -> Picture {
        Picture::None
    }
}

/// The result of a step, besides the new state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// Reward `r`.
    pub reward: f64,
    /// The new state is terminal: nothing comes after it.
    pub terminated: bool,
}
