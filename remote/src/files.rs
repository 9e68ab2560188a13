//! The files with which commands tell gate and relay what to do. Each has a number for its format.

use std::fmt;
use std::fs::Permissions;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use serde::{Deserialize, Serialize};
use shoal_common::run_dir::RunDir;
use shoal_common::versioned_file::{Encoding, VersionedFile, VersionedFileError};

use crate::endpoint::Endpoint;

/// `join.toml` in the directory of a run that other hosts can join.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct JoinFile {
    /// Where other hosts find the gate.
    pub endpoint: Endpoint,
    /// Where the gate listens.
    pub listen: Endpoint,
}

/// A certificate with its private key, and the authority that has signed it and the other side's: the gate's file below
/// `keys/`, or `join.key` for the hosts. Whoever has `join.key` may join.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct KeyFile {
    /// The run's name in its messages.
    pub run_id: String,
    /// The authority's certificate, as PEM.
    pub authority: String,
    /// The certificate, as PEM.
    pub certificate: String,
    private_key: String,
}

impl fmt::Debug for KeyFile {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("KeyFile")
            .field("run_id", &self.run_id)
            .finish_non_exhaustive()
    }
}

impl KeyFile {
    /// The name of the hosts' file, in the run directory and in that of a host.
    pub const JOIN: &str = "join.key";
    /// The name of the gate's file in the run directory.
    pub const GATE: &str = "keys/gate.key";

    /// A certificate with its private key, all as PEM.
    pub fn new(run_id: String, authority: String, certificate: String, private_key: String) -> Self {
        Self {
            run_id,
            authority,
            certificate,
            private_key,
        }
    }

    /// The private key, as PEM.
    pub fn private_key(&self) -> &str {
        &self.private_key
    }

    /// Writes it, accessible to its owner alone.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), FileError> {
        let io = |cause| FileError::Io(path.display().to_string(), cause);
        path.parent().map_or(Ok(()), std::fs::create_dir_all).map_err(io)?;
        self.store(path)?;
        std::fs::set_permissions(path, Permissions::from_mode(0o600)).map_err(io)
    }

    /// Reads the file at `path`; standard input if that is `-`.
    ///
    /// # Errors
    /// When it is missing, damaged, or of another version.
    pub fn read(path: &Path) -> Result<Self, FileError> {
        if path != Path::new("-") {
            return Ok(Self::load(path)?);
        }
        let shown = "standard input";
        let text = std::io::read_to_string(std::io::stdin()).map_err(|cause| FileError::Io(shown.into(), cause))?;
        Ok(Self::parse(shown, text.as_bytes())?)
    }
}

/// `host.toml` in the directory that `shoal join` makes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HostFile {
    /// Where the gate listens.
    pub endpoint: Endpoint,
    /// The name of the run that was joined.
    pub run_id: String,
    /// The number that this host has drawn.
    pub host: u64,
    /// Its name, for people.
    pub name: String,
    /// Number of the launcher's start that admitted it.
    pub epoch: u64,
    /// Its actors.
    pub actors: Vec<u32>,
    /// Its processes have incarnations below this.
    pub limit: u64,
}

/// Why a file cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FileError {
    /// The system refused.
    #[error("cannot use {0}: {1}")]
    Io(String, std::io::Error),
    /// It is damaged.
    #[error("{0} is damaged: {1}")]
    Damaged(String, String),
    /// Another version wrote it.
    #[error("{0} has format {1}; this program reads format {2}")]
    Format(String, u32, u32),
}

impl From<VersionedFileError> for FileError {
    fn from(error: VersionedFileError) -> Self {
        match error {
            VersionedFileError::Read { path, cause } | VersionedFileError::Write { path, cause } => {
                Self::Io(path, cause)
            }
            VersionedFileError::Damaged { path, cause, .. } => Self::Damaged(path, cause),
            VersionedFileError::Format { path, found, expected } => Self::Format(path, found, expected),
        }
    }
}

impl VersionedFile for KeyFile {
    const FORMAT: u32 = 1;
    const ENCODING: Encoding = Encoding::Toml;
}

impl VersionedFile for JoinFile {
    const FORMAT: u32 = 1;
    const ENCODING: Encoding = Encoding::Toml;
}

impl VersionedFile for HostFile {
    const FORMAT: u32 = 1;
    const ENCODING: Encoding = Encoding::Toml;
}

impl JoinFile {
    /// The name of the file in the run directory.
    pub const NAME: &str = "join.toml";

    /// The file of a gate that listens at `listen` and is found at `endpoint`.
    pub fn new(endpoint: Endpoint, listen: Endpoint) -> Self {
        Self { endpoint, listen }
    }

    /// Writes it.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, run: &RunDir) -> Result<(), FileError> {
        Ok(self.store(&run.path().join(Self::NAME))?)
    }

    /// Reads it.
    ///
    /// # Errors
    /// When it is missing, damaged, or of another version.
    pub fn read(directory: &Path) -> Result<Self, FileError> {
        Ok(Self::load(&directory.join(Self::NAME))?)
    }
}

impl HostFile {
    const NAME: &str = "host.toml";

    /// A new file.
    pub fn new(
        endpoint: Endpoint,
        run_id: String,
        (host, name): (u64, String),
        lease: &crate::wire::WireLease,
    ) -> Self {
        Self {
            endpoint,
            run_id,
            host,
            name,
            epoch: lease.epoch,
            actors: lease.actors.clone(),
            limit: lease.limit,
        }
    }

    /// Writes it.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, run: &RunDir) -> Result<(), FileError> {
        Ok(self.store(&run.path().join(Self::NAME))?)
    }

    /// Reads it.
    ///
    /// # Errors
    /// When it is missing, damaged, or of another version.
    pub fn read(run: &RunDir) -> Result<Self, FileError> {
        Ok(Self::load(&run.path().join(Self::NAME))?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::WireLease;

    #[test]
    fn files_are_read_as_they_were_written_and_others_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let run = RunDir::create(&directory.path().join("host")).unwrap();
        let lease = WireLease {
            epoch: 3,
            config: String::new(),
            actors: vec![2, 3],
            first_incarnation: 10,
            limit: 20,
        };
        let endpoint: Endpoint = "tcp/127.0.0.1:7447".parse().unwrap();
        let host = HostFile::new(endpoint.clone(), "1a".into(), (7, "node".into()), &lease);
        host.write(&run).unwrap();
        assert_eq!(HostFile::read(&run).unwrap(), host);
        JoinFile::new(endpoint.clone(), endpoint.clone()).write(&run).unwrap();
        assert_eq!(JoinFile::read(run.path()).unwrap().endpoint, endpoint);
        let path = run.path().join(JoinFile::NAME);
        std::fs::write(
            &path,
            "format = 2\nendpoint = \"tcp/127.0.0.1:1\"\nlisten = \"tcp/127.0.0.1:1\"\n",
        )
        .unwrap();
        assert!(
            JoinFile::read(run.path())
                .unwrap_err()
                .to_string()
                .contains("has format 2")
        );
        std::fs::write(
            &path,
            "format = 1\nendpoint = \"tcp/10.0.0.1:1\"\nlisten = \"tcp/10.0.0.1:1\"\n",
        )
        .unwrap();
        assert!(
            JoinFile::read(run.path())
                .unwrap_err()
                .to_string()
                .contains("is damaged")
        );
        let key = KeyFile::new("1a".into(), "A".into(), "C".into(), "secret".into());
        let path = run.path().join(KeyFile::GATE);
        key.write(&path).unwrap();
        assert_eq!(KeyFile::read(&path).unwrap(), key);
        assert_eq!(std::fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        assert!(!format!("{key:?}").contains("secret"));
        std::fs::write(&path, "format = 1").unwrap();
        assert!(KeyFile::read(&path).unwrap_err().to_string().contains("is damaged"));
    }
}
