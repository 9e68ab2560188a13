//! The sizes of a learner's files.

use shoal_common::commit::MAX_ACTOR_SNAPSHOT_WORDS;
use shoal_common::config::{Config, Mode};
use shoal_common::durable::allocated_bytes;
use shoal_common::run_dir::RunDir;

use super::checkpoint::Checkpoints;
use crate::algorithms::registry;
use crate::replay::{ReplayLayout, unfinished_bytes};

/// Why the files of a run would be too large.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SizeError {
    /// The replay would be larger than a file can be.
    #[error("replay.capacity = {capacity}: no file can be that large; reduce it")]
    Replay {
        /// Transitions that it should hold.
        capacity: u64,
    },
    /// The actors' snapshots would be too large.
    #[error(
        "actors.envs = {envs}: the state of so many environments is too large for a snapshot of an actor; reduce it{n_step}"
    )]
    Snapshot {
        /// Environments of an actor.
        envs: u32,
        /// What else to reduce.
        n_step: &'static str,
    },
    /// All files together would be larger than can be counted.
    #[error("the run's files would have more than 2⁶⁴ bytes; reduce replay.capacity = {capacity}")]
    Sum {
        /// Transitions that the replay should hold.
        capacity: u64,
    },
}

/// Bytes that the learner's files and the best policy need on the disk beyond those that the run in the directory `run`
/// has already. A replay that exists does not count, nor does space that a killed start has already reserved for it.
///
/// # Errors
/// When the files would be too large.
pub fn disk_bytes(config: &Config, run: &RunDir) -> Result<u64, SizeError> {
    let capacity = config.replay.capacity;
    if config.actor_snapshot_words() > MAX_ACTOR_SNAPSHOT_WORDS {
        return Err(SizeError::Snapshot {
            envs: config.actors.envs,
            n_step: if config.replay.n_step > 1 {
                " or replay.n_step"
            } else {
                ""
            },
        });
    }
    let replay = if matches!(run.replay_file().try_exists(), Ok(false)) {
        let offsets = replay_layout(config).offsets().ok_or(SizeError::Replay { capacity })?;
        (offsets.end as u64).saturating_sub(unfinished_bytes(&run.replay_file()))
    } else {
        0
    };
    let (_, policy) = config.learned_shapes().policy;
    // Three checkpoints: the latest, the one before, and the next one while it is written. Three policies: the best,
    // the last, and one while it is written.
    let numbers = 3 * (registry::state_numbers(config) + policy.parameters()) as u64;
    let there = Checkpoints::allocated_bytes(&run.checkpoints())
        + allocated_bytes(&run.best_policy())
        + allocated_bytes(&run.last_policy());
    let sum = numbers
        .checked_mul(size_of::<f32>() as u64)
        .and_then(|bytes| bytes.saturating_sub(there).checked_add(replay));
    sum.ok_or(SizeError::Sum { capacity })
}

/// The layout of a run's replay.
pub fn replay_layout(config: &Config) -> ReplayLayout {
    let chunk = config.chunk_layout();
    ReplayLayout {
        row: chunk.row,
        ring: ring_rows(config),
        actors: config.actors.max as usize,
        actor_snapshot_words: chunk.actor_snapshot_words,
        fingerprint: config.fingerprint(),
    }
}

/// Rows in the ring: the sampling range and, in lockstep, the rows of two checkpoint intervals and two rounds, because
/// a learner that continues from a checkpoint samples them again.
fn ring_rows(config: &Config) -> u64 {
    let chunk = config.chunk_rows() as u64;
    let slack = match config.run.mode {
        Mode::Free => 0,
        Mode::Lockstep => {
            // Without updates there are no checkpoints to continue from.
            let interval = config.checkpoint.every_updates as f64 / config.replay.updates_per_step;
            let rows = if interval.is_finite() { 2.0 * interval } else { 0.0 };
            let round = chunk * u64::from(config.actors.count);
            (rows as u64).saturating_add(2 * round)
        }
    };
    // The ring must hold a chunk even if the window is smaller.
    config.replay.capacity.saturating_add(slack).max(chunk)
}
