//! Checkpoints: a file with everything that a learner needs to continue, and a second one with the checkpoint before.
//!
//! A new checkpoint is written under a temporary name and synced. Then `latest.ckpt` is renamed to `previous.ckpt`, and
//! the new file to `latest.ckpt`. So at any moment at least one of the two is whole, and a damaged one never replaces
//! the older one.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use bincode::config::{self, Config};
use rustix::io::Errno;
use serde::{Deserialize, Serialize};
use shoal_common::durable::{self, FileKind, PreparedFile, SealError, allocated_bytes, sync_directory_of};
use shoal_common::numbers::COUNTER_LIMIT;

use crate::algorithms::registry;
use crate::networks::digest;

const KIND: FileKind = FileKind {
    magic: *b"SHOALCKP",
    version: 2,
    name: "a checkpoint",
};
const LATEST: &str = "latest.ckpt";
const PREVIOUS: &str = "previous.ckpt";

/// A learner's progress.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counters {
    /// Updates so far.
    pub updates: u64,
    /// Environment steps of all actors that count for the ratio of updates: rows of the replay.
    pub rows: u64,
    /// Episodes that end within those rows.
    pub episodes: u64,
    /// Version of the policy published last.
    pub policy_version: u64,
}

/// A learner's state as read back.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Checkpoint {
    /// The learner's progress.
    pub counters: Counters,
    /// The learner's numbers by name, as they were given to `save`.
    pub arrays: Vec<(String, Vec<f32>)>,
}

impl Checkpoint {
    /// SHA-256 of the learned weights, in the order of [`registry::weight_names`]; for DDPG: actor, critic and both
    /// targets. If observations are normalised, their statistics are included.
    pub fn weights_sha256(&self, config: &shoal_common::config::Config) -> String {
        let array = |name| self.arrays.iter().find(|(found, _)| found == name);
        let weights = registry::weight_names(config).into_iter().filter_map(array);
        digest::sha256(&weights.map(|(_, numbers)| numbers.as_slice()).collect::<Vec<_>>())
    }
}

/// Why a checkpoint was not written or read. The files on the disk have not changed.
#[derive(Debug, thiserror::Error)]
pub enum CheckpointError {
    /// It could not be written. The last one is intact.
    #[error(
        "{path}: cannot write the checkpoint: {source}; free some space or check the permissions of the directory (the \
             last checkpoint is intact)"
    )]
    Write {
        /// The checkpoint file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// It could not be read. It may be whole.
    #[error("{path}: cannot read the checkpoint: {source}; the file was left as it is")]
    Read {
        /// The checkpoint file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// It is whole, but of another program version or configuration, so it must not be overwritten.
    #[error(
        "{path}: this checkpoint {reason}; the file was left as it is: resume with the run's own configuration and \
             program"
    )]
    Refused {
        /// The checkpoint file.
        path: PathBuf,
        /// What differs.
        reason: String,
    },
    /// There are checkpoints, and none of them can be used.
    #[error(
        "{directory}: no checkpoint here can be used ({reasons}); the files were left as they are: restore a copy \
             of one, or move them away to start learning again on the same replay"
    )]
    AllDamaged {
        /// The checkpoints' directory.
        directory: PathBuf,
        /// Each file and what is wrong with it.
        reasons: String,
    },
}

/// What `load_newest` found.
#[derive(Clone, Debug, PartialEq)]
pub struct LoadedCheckpoint {
    /// The newest checkpoint that is whole.
    pub checkpoint: Checkpoint,
    /// What is wrong with newer ones, for the run's log.
    pub warnings: Vec<String>,
}

/// A step that `save` has just finished. Tests stop it there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SaveStep {
    /// The new checkpoint is on the disk, under its temporary name.
    Prepared,
    /// `latest.ckpt` has become `previous.ckpt` or, if it was damaged, `damaged-<number>.ckpt`.
    Kept,
    /// The new checkpoint is `latest.ckpt`.
    Published,
}

/// The checkpoints of a run. One process at a time writes them.
#[derive(Debug)]
pub struct Checkpoints {
    directory: PathBuf,
    fingerprint: u64,
    /// Whether `latest.ckpt` exists and is whole; `None` if that has not been checked.
    latest_is_whole: Option<bool>,
    hook: fn(SaveStep),
}

#[derive(Serialize, Deserialize)]
struct Header {
    fingerprint: u64,
    counters: Counters,
    /// Name and length of each array, in the order of their numbers.
    arrays: Vec<(String, u64)>,
}

/// The content of one of the two files.
enum CheckpointFile {
    Missing,
    Whole(Checkpoint),
    Damaged(String),
}

impl Checkpoints {
    /// The checkpoints in `directory` of the configuration that `fingerprint` identifies.
    pub fn new(directory: &Path, fingerprint: u64) -> Self {
        Self {
            directory: directory.into(),
            fingerprint,
            latest_is_whole: None,
            hook: |_| (),
        }
    }

    /// Bytes of disk that the checkpoints in `directory` occupy, including one that a killed learner left unfinished.
    /// Later checkpoints replace all of them.
    pub(crate) fn allocated_bytes(directory: &Path) -> u64 {
        let names = [LATEST, PREVIOUS, "latest.ckpt.new"];
        names.map(|name| allocated_bytes(&directory.join(name))).iter().sum()
    }

    /// Calls `hook` after each step of every later `save`, for crash tests.
    pub fn on_step(&mut self, hook: fn(SaveStep)) {
        self.hook = hook;
    }

    /// Reads the newest checkpoint that is whole; `None` if there is none at all.
    pub fn load_newest(&mut self) -> Result<Option<LoadedCheckpoint>, CheckpointError> {
        let latest = self.read(LATEST)?;
        self.latest_is_whole = Some(matches!(latest, CheckpointFile::Whole(_)));
        let latest_path = self.directory.join(LATEST);
        let mut warnings = match latest {
            CheckpointFile::Whole(checkpoint) => {
                return Ok(Some(LoadedCheckpoint {
                    checkpoint,
                    warnings: vec![],
                }));
            }
            CheckpointFile::Missing => vec![],
            CheckpointFile::Damaged(reason) => vec![format!("{}: {reason}", latest_path.display())],
        };
        let previous = self.directory.join(PREVIOUS);
        match self.read(PREVIOUS)? {
            CheckpointFile::Whole(checkpoint) => {
                if warnings.is_empty() {
                    warnings.push(format!(
                        "{}: missing, probably after a crash while it was being replaced",
                        latest_path.display()
                    ));
                }
                let used = format!(
                    "continuing from {}, after {} updates",
                    previous.display(),
                    checkpoint.counters.updates
                );
                warnings.push(used);
                return Ok(Some(LoadedCheckpoint { checkpoint, warnings }));
            }
            CheckpointFile::Missing => {}
            CheckpointFile::Damaged(reason) => warnings.push(format!("{}: {reason}", previous.display())),
        }
        if warnings.is_empty() {
            return Ok(None);
        }
        Err(CheckpointError::AllDamaged {
            directory: self.directory.clone(),
            reasons: warnings.join("; "),
        })
    }

    /// Writes a checkpoint. When this returns it is on the disk: a power loss leaves it or a later one.
    pub fn save(&mut self, counters: &Counters, arrays: &[(&str, &[f32])]) -> Result<(), CheckpointError> {
        let prepared = self.prepare(counters, arrays)?;
        (self.hook)(SaveStep::Prepared);
        self.keep_latest()?;
        (self.hook)(SaveStep::Kept);
        self.publish(prepared)?;
        (self.hook)(SaveStep::Published);
        Ok(())
    }

    fn prepare(&self, counters: &Counters, arrays: &[(&str, &[f32])]) -> Result<PreparedFile, CheckpointError> {
        let path = self.directory.join(LATEST);
        let header = Header {
            fingerprint: self.fingerprint,
            counters: *counters,
            arrays: arrays
                .iter()
                .map(|(name, numbers)| ((*name).to_owned(), numbers.len() as u64))
                .collect(),
        };
        PreparedFile::write(&path, |file| {
            durable::seal(KIND, file, |body| {
                body.write_all(&bincode::serde::encode_to_vec(&header, encoding()).map_err(io::Error::other)?)?;
                arrays
                    .iter()
                    .try_for_each(|(_, numbers)| body.write_all(bytemuck::cast_slice(numbers)))
            })
        })
        .map_err(|source| CheckpointError::Write { path, source })
    }

    /// Frees the name `latest.ckpt`: a whole one becomes the previous one, a damaged one is renamed to an unused name.
    fn keep_latest(&mut self) -> Result<(), CheckpointError> {
        let latest = self.directory.join(LATEST);
        let is_whole = match self.latest_is_whole {
            Some(is_whole) => is_whole,
            None => matches!(self.read(LATEST)?, CheckpointFile::Whole(_)),
        };
        let kept = if is_whole {
            self.directory.join(PREVIOUS)
        } else {
            self.unused_name()
        };
        self.latest_is_whole = Some(false);
        match fs::rename(&latest, kept) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(CheckpointError::Write {
                path: latest,
                source: error,
            }),
            // Synced to keep this order on the disk: the old one must have its new name before it is replaced.
            _ => sync_directory_of(&latest).map_err(|source| CheckpointError::Write { path: latest, source }),
        }
    }

    fn publish(&mut self, prepared: PreparedFile) -> Result<(), CheckpointError> {
        prepared.publish().map_err(|source| CheckpointError::Write {
            path: self.directory.join(LATEST),
            source,
        })?;
        self.latest_is_whole = Some(true);
        Ok(())
    }

    fn unused_name(&self) -> PathBuf {
        let mut number = 0;
        loop {
            let path = self.directory.join(format!("damaged-{number}.ckpt"));
            if !path.exists() {
                return path;
            }
            number += 1;
        }
    }

    fn read(&self, name: &str) -> Result<CheckpointFile, CheckpointError> {
        let path = self.directory.join(name);
        let refused = |reason| CheckpointError::Refused {
            path: path.clone(),
            reason,
        };
        let body = match durable::read_sealed(KIND, &path) {
            Ok(body) => body,
            Err(SealError::Io(error)) if error.kind() == io::ErrorKind::NotFound => return Ok(CheckpointFile::Missing),
            Err(SealError::Io(source)) if !is_damage(&source) => return Err(CheckpointError::Read { path, source }),
            Err(error @ SealError::Version { .. }) => return Err(refused(error.to_string())),
            Err(error) => return Ok(CheckpointFile::Damaged(error.to_string())),
        };
        let Some((header, numbers)) = parse(&body) else {
            return Ok(CheckpointFile::Damaged("its parts do not fit together".into()));
        };
        if header.fingerprint != self.fingerprint {
            return Err(refused(format!(
                "was written under another configuration (fingerprint {:016x}, this run's is {:016x})",
                header.fingerprint, self.fingerprint
            )));
        }
        let arrays = header.arrays.into_iter().map(|(name, _)| name).zip(numbers).collect();
        Ok(CheckpointFile::Whole(Checkpoint {
            counters: header.counters,
            arrays,
        }))
    }
}

/// Whether the error shows a damaged disk or file system. Others, such as too many open files, may be temporary.
fn is_damage(error: &io::Error) -> bool {
    Errno::from_io_error(error).is_some_and(|errno| [Errno::IO, Errno::UCLEAN, Errno::BADMSG].contains(&errno))
}

/// Splits a body into its header and the numbers of each array; `None` unless the lengths add up to the body's and all
/// counters are below [`COUNTER_LIMIT`].
fn parse(body: &[u8]) -> Option<(Header, Vec<Vec<f32>>)> {
    let (header, read): (Header, usize) = bincode::serde::decode_from_slice(body, encoding()).ok()?;
    let (mut rest, odd) = body.get(read..)?.as_chunks::<{ size_of::<f32>() }>();
    let Counters {
        updates,
        rows,
        episodes,
        policy_version,
    } = header.counters;
    if updates.max(rows).max(episodes).max(policy_version) >= COUNTER_LIMIT {
        return None;
    }
    let mut arrays = Vec::with_capacity(header.arrays.len());
    for (_, length) in &header.arrays {
        let (numbers, after) = rest.split_at_checked(usize::try_from(*length).ok()?)?;
        arrays.push(numbers.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect());
        rest = after;
    }
    (rest.is_empty() && odd.is_empty()).then_some((header, arrays))
}

/// The limit keeps an absurd length from allocating memory.
fn encoding() -> impl Config {
    config::standard().with_fixed_int_encoding().with_limit::<{ 1 << 16 }>()
}

#[cfg(test)]
mod tests;
