//! What a learning method is to the learner's process.

use shoal_common::config::Config;
use shoal_common::policy::{PolicyError, PolicyLayout};
use shoal_common::space::EnvironmentSpec;

use crate::networks::threads::Threads;
use crate::replay::Replay;

/// A learning method by its settings, before it learns.
pub trait Method {
    /// The learner of an environment like `spec`, before its first update; its first weights are drawn from `seed`.
    ///
    /// # Errors
    /// When the method cannot control that environment.
    fn start(&self, spec: &EnvironmentSpec, seed: u64, room: Room) -> Result<Box<dyn Algorithm>, PolicyError>;

    /// Names of the sections that hold what was learned, as opposed to what the learning remembers.
    fn weights(&self) -> &'static [&'static str];

    /// Numbers in all sections of the learner's state.
    fn state_numbers(&self, spec: &EnvironmentSpec, room: Room) -> usize;
}

/// A learner at work: what it does with the rows of the replay, what actors act with, and what a checkpoint keeps of it.
pub trait Algorithm {
    /// The policy's parameters.
    fn policy(&self) -> &[f32];

    /// What they are.
    fn layout(&self) -> PolicyLayout;

    /// Updates done. A method that learns from each row once has as many as it has learned from rows.
    fn updates(&self) -> u64;

    /// Does what is due next, on the replay as it was at `rows` rows, and counts it: an update or several. To be called
    /// while the rows allow more updates than are done.
    fn update(&mut self, replay: &Replay, rows: u64) -> Losses;

    /// Shares the work of updates among these threads from now on, where there is enough of it. Not a bit of what is
    /// learned depends on them.
    fn set_threads(&mut self, _: Threads) {}

    /// All that the next update depends on besides the rows, by name.
    fn state(&self) -> Vec<Section<'_>>;

    /// Goes back to a state of the same method after so many updates.
    ///
    /// # Errors
    /// When the state is another method's. The method is unusable afterwards.
    fn restore(&mut self, updates: u64, saved: &mut SavedState) -> Result<(), SectionError>;
}

/// A part of a method's state: its name and its numbers.
pub type Section<'a> = (&'static str, &'a [f32]);

/// How an update went.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    /// Mean squared error of what estimates values: the critic, the baseline, or the table.
    pub critic_loss: f32,
    /// What the policy's step makes smaller; 0 where the policy follows from the values.
    pub actor_loss: f32,
    /// Mean of the values estimated, or of the returns where none are.
    pub q_mean: f32,
}

/// What every method is told.
#[derive(Clone, Copy, Debug)]
pub struct Room {
    /// Transitions that minibatches are sampled from.
    pub capacity: u64,
    /// Rows in a full chunk.
    pub chunk_rows: usize,
    /// Actors that take part.
    pub actors: u32,
    /// Environments of each.
    pub envs: u32,
}

impl From<&Config> for Room {
    fn from(config: &Config) -> Self {
        Self {
            capacity: config.replay.capacity,
            chunk_rows: config.chunk_rows(),
            actors: config.actors.count,
            envs: config.actors.envs,
        }
    }
}

/// A method's state as a checkpoint gives it back: numbers by name.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SavedState(Vec<(String, Vec<f32>)>);

/// A state does not hold what the method expects.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the checkpoint's section `{name}` {reason}; it was written by another version of the program")]
pub struct SectionError {
    name: String,
    reason: String,
}

impl From<Vec<(String, Vec<f32>)>> for SavedState {
    fn from(sections: Vec<(String, Vec<f32>)>) -> Self {
        Self(sections)
    }
}

impl SectionError {
    /// A section has not as many numbers as it should.
    pub(super) fn of_length(name: &str, found: usize, expected: usize) -> Self {
        Self {
            name: name.into(),
            reason: format!("has {found} numbers instead of {expected}"),
        }
    }
}

impl SavedState {
    /// Takes out a section.
    ///
    /// # Errors
    /// When it is not there, or has not `length` numbers.
    pub fn take(&mut self, name: &str, length: usize) -> Result<Vec<f32>, SectionError> {
        let at = self.0.iter().position(|(found, _)| found == name);
        let at = at.ok_or_else(|| SectionError {
            name: name.into(),
            reason: "is missing".into(),
        })?;
        match self.0[at].1.len() {
            found if found == length => Ok(self.0.swap_remove(at).1),
            found => Err(SectionError::of_length(name, found, length)),
        }
    }
}
