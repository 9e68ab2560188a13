//! What a learning method is to the learner's process, and the list of those there are.

use shoal_common::config;
use shoal_common::policy::{PolicyError, PolicyLayout};
use shoal_common::space::EnvironmentSpec;

use crate::checkpoint::{Checkpoint, SectionError};
use crate::ddpg::{DdpgError, DdpgState};
use crate::reinforce::Reinforce;
use crate::replay::Replay;
use crate::replayed_ddpg::ReplayedDdpg;
use crate::tabular::{Method, Tabular};
use crate::threads::Threads;

/// A learning method: what it does with the rows of the replay, what actors act with, and what a checkpoint keeps of it.
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
    /// When the checkpoint holds another one's; nothing is to be done with the method then.
    fn restore(&mut self, updates: u64, checkpoint: &mut Checkpoint) -> Result<(), SectionError>;
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

/// Why a method cannot learn.
#[derive(Debug, thiserror::Error)]
pub enum AlgorithmError {
    /// It cannot control the environment.
    #[error(transparent)]
    Policy(#[from] PolicyError),
    /// DDPG cannot be made so.
    #[error(transparent)]
    Ddpg(#[from] DdpgError),
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

/// The method of a configuration, before its first update.
///
/// # Errors
/// When it cannot control the environment, or a number is out of range.
pub fn new(
    algorithm: &config::Algorithm,
    spec: &EnvironmentSpec,
    seed: u64,
    room: Room,
) -> Result<Box<dyn Algorithm>, AlgorithmError> {
    Ok(match algorithm {
        config::Algorithm::Ddpg(ddpg, _) => Box::new(ReplayedDdpg::new(spec, ddpg, seed, room.capacity)?),
        config::Algorithm::Reinforce(reinforce) => Box::new(Reinforce::new(reinforce, spec, seed, room)?),
        config::Algorithm::QLearning(tabular) => Box::new(Tabular::new(Method::QLearning, tabular, spec, room)?),
        config::Algorithm::Sarsa(tabular) => Box::new(Tabular::new(Method::Sarsa, tabular, spec, room)?),
    })
}

/// Names of the sections that hold what was learned, as opposed to what the learning remembers.
pub fn weights(algorithm: &config::Algorithm) -> &'static [&'static str] {
    match algorithm {
        config::Algorithm::Ddpg(..) => &DdpgState::PARTS[..4],
        config::Algorithm::Reinforce(_) => &Reinforce::WEIGHTS,
        config::Algorithm::QLearning(_) | config::Algorithm::Sarsa(_) => &Tabular::WEIGHTS,
    }
}
