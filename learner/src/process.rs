//! The learner's process.
//!
//! ```text
//! chunks ─▶ replay ─▶ algorithm.update ─▶ policy
//!           (mapped)              └─▶ checkpoint
//! ```

pub mod checkpoint;
mod error;
mod evaluation_wait;
mod free;
pub mod intake;
mod learner;
mod lockstep;
mod settings;
mod sizes;

use shoal_common::channel::Domain;
use shoal_common::config::Mode;
use shoal_common::exit::Exit;
use shoal_common::stop::Stop;

pub use self::error::LearnerError;
use self::learner::Learner;
pub use self::settings::LearnerSettings;
pub use self::sizes::{SizeError, disk_bytes, replay_layout};

/// Learns until all of the run's environment steps are collected and learned from, or until `stop`. Saves its state in
/// both cases.
///
/// # Errors
/// When a channel, the replay or a checkpoint cannot be used, or learning diverges.
pub fn run(domain: &Domain, settings: &LearnerSettings, stop: &Stop) -> Result<(), LearnerError> {
    let mut learner = Learner::new(domain, settings, stop)?;
    let ended = match settings.config.run.mode {
        Mode::Free => free::run(&mut learner),
        Mode::Lockstep => lockstep::run(&mut learner),
    };
    match ended {
        Ok(()) => learner.finish(),
        Err(Exit::Stopped) => {
            if settings.config.run.mode == Mode::Free {
                learner.take_last_chunks()?;
            }
            learner.finish()
        }
        Err(Exit::Failed(error)) => Err(error),
    }
}
