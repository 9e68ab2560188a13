//! The learning methods there are.

use shoal_common::config;
use shoal_common::policy::PolicyError;
use shoal_common::space::EnvironmentSpec;

use super::algorithm::{Algorithm, Room};
use super::ddpg::replayed::ReplayedDdpg;
use super::ddpg::{DdpgError, DdpgState};
use super::reinforce::Reinforce;
use super::tabular::{Method, Tabular};

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
