//! The interface between a learning algorithm and the learner's process.

use std::borrow::Cow;

use shoal_common::config::Config;
use shoal_common::policy::{PolicyError, PolicyLayout};
use shoal_common::space::EnvironmentSpec;

use crate::networks::product::Products;
use crate::networks::threads::Threads;
use crate::replay::Replay;

/// Creates an algorithm from its settings, and says beforehand how large its state is and how much work its updates
/// are.
pub trait AlgorithmDefinition {
    /// The algorithm of a run with this configuration, before its first update.
    ///
    /// # Errors
    /// When the algorithm cannot control the environment.
    fn create(&self, config: &Config) -> Result<Box<dyn Algorithm>, PolicyError>;

    /// Names of the arrays that hold what was learned, as opposed to the state of the optimiser. The statistics of
    /// normalised observations are not among them.
    fn weight_names(&self) -> &'static [&'static str];

    /// The matrix products of one or a few updates in an environment like `spec`; none if the algorithm has no
    /// networks, or if its updates have no fixed size.
    fn products(&self, _spec: &EnvironmentSpec) -> Products {
        Products::default()
    }

    /// The total length of all arrays of the algorithm's state, without the statistics of normalised observations. It
    /// is asked for before the algorithm exists.
    fn state_numbers(&self, spec: &EnvironmentSpec, sizes: RunSizes) -> usize;
}

/// An algorithm that is learning: its updates from rows of the replay, its policy for the actors, and its state for
/// checkpoints.
pub trait Algorithm {
    /// The policy's parameters.
    fn policy(&self) -> Cow<'_, [f32]>;

    /// The layout of the policy that `AlgorithmSettings::behaviour` returns. Readers of the policy compare its
    /// fingerprint with their own.
    fn layout(&self) -> PolicyLayout;

    /// Updates so far, as [`shoal_common::report`] defines them.
    fn updates(&self) -> u64;

    /// Makes one or more updates from rows before `rows`, and adds their number to [`updates`](Self::updates). The
    /// learner calls it until `updates` has reached what the ratio allows for these rows; for an algorithm that
    /// consumes rows, that is `rows`. Returns `None` if nothing was learned. A loss that is not finite ends the run.
    fn update(&mut self, replay: &Replay, rows: u64) -> Option<Losses>;

    /// Shares the work of updates among these threads from now on, if there is enough of it. The bits of the results do
    /// not depend on them.
    fn set_threads(&mut self, _: Threads) {}

    /// Everything that the next update depends on besides the rows and `updates`, by name. The names never change.
    fn state(&self) -> Vec<StateArray<'_>>;

    /// Restores a state of the same algorithm after `updates` updates.
    ///
    /// # Errors
    /// When the state is another algorithm's. The algorithm is unusable afterwards.
    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), StateArrayError>;
}

/// An array of an algorithm's state: its name and its numbers.
pub type StateArray<'a> = (&'static str, &'a [f32]);

/// As [`StateArray`], but the numbers can be overwritten.
pub type StateArrayMut<'a> = (&'static str, &'a mut [f32]);

/// What an update reports.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Error of the value estimates: of the critics, the baseline, or the table. It is the mean squared error, of two
    /// critics their sum, or for DQN the mean of Huber's loss.
    pub critic_loss: f32,
    /// The loss that the policy's step reduces; 0 if the policy follows from the values.
    pub actor_loss: f32,
    /// Mean of the estimated values, or of the returns if there are no estimates.
    pub q_mean: f32,
    /// The temperature α with which these losses were computed; `None` for algorithms without one.
    pub temperature: Option<f32>,
}

/// Sums of what updates report.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct LossSums {
    pub(crate) critic_loss: f64,
    pub(crate) actor_loss: f64,
    pub(crate) q_mean: f64,
    /// NaN if the algorithm has none.
    pub(crate) temperature: f64,
    pub(crate) updates: u64,
}

impl LossSums {
    pub(crate) fn add(&mut self, losses: Losses) {
        self.critic_loss += f64::from(losses.critic_loss);
        self.actor_loss += f64::from(losses.actor_loss);
        self.q_mean += f64::from(losses.q_mean);
        self.temperature += losses.temperature.map_or(f64::NAN, f64::from);
        self.updates += 1;
    }
}

/// The sizes of a run that algorithms depend on.
#[derive(Clone, Copy, Debug)]
pub struct RunSizes {
    /// Transitions that minibatches are sampled from.
    pub capacity: u64,
    /// Rows in a full chunk.
    pub chunk_rows: usize,
    /// The number of actors.
    pub actors: u32,
    /// The number of environments of each actor.
    pub envs: u32,
}

impl From<&Config> for RunSizes {
    fn from(config: &Config) -> Self {
        Self {
            capacity: config.replay.capacity,
            chunk_rows: config.chunk_rows(),
            actors: config.actors.count,
            envs: config.actors.envs,
        }
    }
}

/// An algorithm's state as read from a checkpoint: numbers by name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SavedState(Vec<(String, Vec<f32>)>);

/// An array of a saved state is not what the algorithm expects.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the checkpoint's array `{name}` {reason}; it was written by another version of the program")]
pub struct StateArrayError {
    name: String,
    reason: String,
}

impl From<Vec<(String, Vec<f32>)>> for SavedState {
    fn from(arrays: Vec<(String, Vec<f32>)>) -> Self {
        Self(arrays)
    }
}

impl StateArrayError {
    /// An array has the wrong length.
    pub(super) fn of_length(name: &str, found: usize, expected: usize) -> Self {
        Self {
            name: name.into(),
            reason: format!("has {found} numbers instead of {expected}"),
        }
    }
}

impl SavedState {
    /// Removes an array and returns it.
    ///
    /// # Errors
    /// When it is missing, or does not have `length` numbers.
    pub fn take(&mut self, name: &str, length: usize) -> Result<Vec<f32>, StateArrayError> {
        let at = self.0.iter().position(|(found, _)| found == name);
        let at = at.ok_or_else(|| StateArrayError {
            name: name.into(),
            reason: "is missing".into(),
        })?;
        match self.0[at].1.len() {
            found if found == length => Ok(self.0.swap_remove(at).1),
            found => Err(StateArrayError::of_length(name, found, length)),
        }
    }

    /// As [`take`](Self::take); `None` if it is missing.
    ///
    /// # Errors
    /// When it does not have `length` numbers.
    pub fn take_if_any(&mut self, name: &str, length: usize) -> Result<Option<Vec<f32>>, StateArrayError> {
        let exists = self.0.iter().any(|(found, _)| found == name);
        exists.then(|| self.take(name, length)).transpose()
    }
}
