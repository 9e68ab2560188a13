//! Policy files, for example the best policy of a run.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use shoal_base::durable::{self, FileKind, SealError};

use crate::PolicyLayout;

const KIND: FileKind = FileKind {
    magic: *b"SHOALPOL",
    version: 1,
    name: "a policy file",
};

/// A policy's parameters, the fingerprint of their layout, and the result of the policy's evaluation.
#[derive(Clone, Debug, PartialEq)]
pub struct PolicyFile {
    /// Identifies the layout of the parameters, as in the `policy` channel.
    pub fingerprint: u64,
    /// The policy's version.
    pub version: u64,
    /// Environment steps of all actors that it was learned from.
    pub env_steps: u64,
    /// Mean return of its evaluation.
    pub return_mean: f64,
    /// Standard deviation of the return in its evaluation.
    pub return_std: f64,
    /// Episodes of its evaluation.
    pub episodes: u64,
    /// The parameters, as a flat list.
    pub parameters: Vec<f32>,
}

/// Why a policy file cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum PolicyFileError {
    /// The file does not exist (yet).
    #[error("{0}: there is no policy here; has the run been evaluated yet?")]
    Missing(PathBuf),
    /// The file exists, but cannot be used.
    #[error("{path}: {reason}; the file was left as it is")]
    Refused {
        /// The policy file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The file cannot be written. An older file is intact.
    #[error("{path}: cannot write the policy: {source}; free some space or check the permissions of the directory")]
    Write {
        /// The policy file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

impl PolicyFile {
    /// Writes the policy atomically to `path`.
    pub fn write(&self, path: &Path) -> Result<(), PolicyFileError> {
        durable::write_atomically(path, |file| {
            durable::seal(KIND, file, |body| {
                body.write_all(bytemuck::cast_slice(&self.head()))?;
                body.write_all(bytemuck::cast_slice(&self.parameters))
            })
        })
        .map_err(|source| PolicyFileError::Write {
            path: path.into(),
            source,
        })
    }

    /// Reads the policy at `path`, which must have this layout and the right number of parameters.
    pub fn read(path: &Path, layout: &PolicyLayout) -> Result<Self, PolicyFileError> {
        let refused = |reason| PolicyFileError::Refused {
            path: path.into(),
            reason,
        };
        let body = match durable::read_sealed(KIND, path) {
            Err(SealError::Io(error)) if error.kind() == io::ErrorKind::NotFound => {
                return Err(PolicyFileError::Missing(path.into()));
            }
            body => body.map_err(|error| refused(error.to_string()))?,
        };
        let policy = Self::parse(&body).ok_or_else(|| refused("its parts do not fit together".into()))?;
        let (fingerprint, parameters) = (layout.fingerprint(), layout.parameters());
        if policy.fingerprint != fingerprint {
            return Err(refused(format!(
                "it is for another network (fingerprint {:016x}, expected {fingerprint:016x})",
                policy.fingerprint
            )));
        }
        if policy.parameters.len() != parameters {
            let found = policy.parameters.len();
            return Err(refused(format!(
                "it has {found} parameters, but its network has {parameters}"
            )));
        }
        Ok(policy)
    }

    /// As [`PolicyFile::read`]; `None` if there is no such file. One that cannot be inspected is an error.
    pub fn read_if_any(path: &Path, layout: &PolicyLayout) -> Result<Option<Self>, PolicyFileError> {
        match Self::read(path, layout) {
            Err(PolicyFileError::Missing(_)) => Ok(None),
            read => read.map(Some),
        }
    }

    /// The words before the parameters, in the order of the file.
    fn head(&self) -> [u64; HEAD_WORDS] {
        [
            self.fingerprint,
            self.version,
            self.env_steps,
            self.return_mean.to_bits(),
            self.return_std.to_bits(),
            self.episodes,
            self.parameters.len() as u64,
        ]
    }

    fn parse(body: &[u8]) -> Option<Self> {
        let (head, parameters) = body.split_at_checked(HEAD_WORDS * size_of::<u64>())?;
        let (words, _) = head.as_chunks::<{ size_of::<u64>() }>();
        let [fingerprint, version, env_steps, mean, std, episodes, count] =
            <[[u8; 8]; HEAD_WORDS]>::try_from(words).ok()?.map(u64::from_le_bytes);
        let (parameters, rest) = parameters.as_chunks::<{ size_of::<f32>() }>();
        (rest.is_empty() && parameters.len() as u64 == count).then(|| Self {
            fingerprint,
            version,
            env_steps,
            return_mean: f64::from_bits(mean),
            return_std: f64::from_bits(std),
            episodes,
            parameters: parameters.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect(),
        })
    }
}

const HEAD_WORDS: usize = 7;

#[cfg(test)]
mod tests {
    use std::fs;

    use crate::network::{Hidden, NetworkLayout};
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn layout() -> PolicyLayout {
        PolicyLayout::Deterministic(NetworkLayout::new(1, Hidden::relu([1, 1]), 1))
    }

    fn policy() -> PolicyFile {
        PolicyFile {
            fingerprint: layout().fingerprint(),
            version: 8,
            env_steps: 9,
            return_mean: -150.25,
            return_std: 94.5,
            episodes: 100,
            parameters: vec![1.0, -2.5, 1e-40, 0.0, -0.0, 4.0],
        }
    }

    #[test]
    fn a_policy_is_read_back_as_written_and_replaced_by_a_better_one() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("best.policy");
        assert!(matches!(
            PolicyFile::read(&path, &layout()),
            Err(PolicyFileError::Missing(_))
        ));
        assert_eq!(PolicyFile::read_if_any(&path, &layout()).unwrap(), None);
        std::os::unix::fs::symlink(&path, &path).unwrap();
        assert!(
            PolicyFile::read_if_any(&path, &layout()).is_err(),
            "a path that cannot be followed is no missing file"
        );
        policy().write(&path).unwrap();
        assert_eq!(PolicyFile::read_if_any(&path, &layout()).unwrap(), Some(policy()));
        assert_eq!(PolicyFile::read(&path, &layout()).unwrap(), policy());
        let better = PolicyFile {
            version: 9,
            parameters: vec![2.0; 6],
            ..policy()
        };
        better.write(&path).unwrap();
        assert_eq!(PolicyFile::read(&path, &layout()).unwrap(), better);
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert_eq!(fs::read_dir(&directory).unwrap().count(), 1);
    }

    #[test]
    fn a_truncated_or_changed_policy_or_one_for_another_network_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("best.policy");
        policy().write(&path).unwrap();
        assert!(
            PolicyFile::read(
                &path,
                &PolicyLayout::Deterministic(NetworkLayout::new(2, Hidden::relu([1, 1]), 1))
            )
            .unwrap_err()
            .to_string()
            .contains("another network")
        );
        let whole = fs::read(&path).unwrap();
        for at in 0..whole.len() {
            fs::write(&path, &whole[..at]).unwrap();
            assert!(
                matches!(PolicyFile::read(&path, &layout()), Err(PolicyFileError::Refused { .. })),
                "cut to {at} bytes"
            );
            let mut damaged = whole.clone();
            damaged[at] ^= 4;
            fs::write(&path, damaged).unwrap();
            assert!(
                matches!(PolicyFile::read(&path, &layout()), Err(PolicyFileError::Refused { .. })),
                "byte {at}"
            );
        }
        durable::write_atomically(&path, |file| durable::seal(KIND, file, |body| body.write_all(&[0; 60]))).unwrap();
        assert!(
            PolicyFile::read(&path, &layout())
                .unwrap_err()
                .to_string()
                .contains("do not fit together")
        );
    }

    #[test]
    fn a_failed_write_leaves_only_the_old_policy() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("best.policy");
        policy().write(&path).unwrap();
        let failed = durable::write_atomically(&path, |_| Err(io::Error::other("disk full")));
        assert_eq!(failed.unwrap_err().to_string(), "disk full");
        assert_eq!(PolicyFile::read(&path, &layout()).unwrap(), policy());
        assert_eq!(fs::read_dir(&directory).unwrap().count(), 1);
    }
}
