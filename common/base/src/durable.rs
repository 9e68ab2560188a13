//! Files that are either whole or not there: written under another name, synced, then renamed; and the envelope that
//! shows when one was damaged afterwards.

use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, BufWriter, Read, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// A file that is complete and on the disk, still under its temporary name. Dropped unpublished, it is removed.
#[derive(Debug)]
#[must_use = "the file appears only when it is published"]
pub struct Prepared {
    temporary: PathBuf,
    path: PathBuf,
    published: bool,
}

impl Prepared {
    /// Writes and syncs what `write` gives, for `path`, readable by the owner alone. What a process killed here before
    /// has left under the temporary name (`path` with `.new` appended) is overwritten.
    pub fn write<E: From<io::Error>>(
        path: &Path,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
    ) -> Result<Self, E> {
        let (prepared, file) = Self::unsynced(path, write)?;
        file.sync_all()?;
        Ok(prepared)
    }

    fn unsynced<E: From<io::Error>>(
        path: &Path,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
    ) -> Result<(Self, File), E> {
        let mut temporary = path.as_os_str().to_owned();
        temporary.push(".new");
        let temporary = PathBuf::from(temporary);
        let file = OpenOptions::new()
            .write(true)
            .create(true)
            .truncate(true)
            .mode(0o600)
            .open(&temporary)?;
        let prepared = Self {
            temporary,
            path: path.into(),
            published: false,
        };
        file.set_permissions(Permissions::from_mode(0o600))?;
        let mut writer = BufWriter::with_capacity(1 << 16, file);
        write(&mut writer)?;
        let file = writer.into_inner().map_err(io::IntoInnerError::into_error)?;
        Ok((prepared, file))
    }

    /// Gives the file its name, replacing in one step what had it.
    pub fn publish(mut self) -> io::Result<()> {
        self.rename()?;
        sync_directory_of(&self.path)
    }

    fn rename(&mut self) -> io::Result<()> {
        fs::rename(&self.temporary, &self.path)?;
        self.published = true;
        Ok(())
    }
}

impl Drop for Prepared {
    fn drop(&mut self) {
        if !self.published {
            // Nothing to do about a failure here: the next write uses the same temporary name.
            let _ = fs::remove_file(&self.temporary);
        }
    }
}

/// Writes a file so that at any moment `path` is what it was before or all of what `write` gives, after a power loss too.
pub fn write_atomically<E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), E> {
    Ok(Prepared::write(path, write)?.publish()?)
}

/// Writes a file so that at any moment `path` is what it was before or all of what `write` gives, whichever process dies. It does
/// not wait for the disk: a power loss may leave the file damaged.
pub fn write_at_once<E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), E> {
    let (mut prepared, _) = Prepared::unsynced(path, write)?;
    Ok(prepared.rename()?)
}

/// Makes the names in the directory of `path` survive a power loss.
pub fn sync_directory_of(path: &Path) -> io::Result<()> {
    let directory = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    File::open(directory)?.sync_all()
}

/// What a sealed file of some kind begins with.
#[derive(Clone, Copy, Debug)]
pub struct Kind {
    /// Tells the kind of file.
    pub magic: [u8; 8],
    /// Its format; raise it with every change.
    pub version: u32,
    /// The kind in words, for messages: "a checkpoint".
    pub name: &'static str,
}

/// Why a sealed file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SealError {
    /// It cannot be read at all (`NotFound` included).
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
    /// Another kind of file.
    #[error("is not {0}")]
    Kind(&'static str),
    /// Another format of the same kind.
    #[error("has format version {found}, this program reads version {expected}")]
    Version {
        /// The file's.
        found: u32,
        /// This program's.
        expected: u32,
    },
    /// Cut short or changed since it was written.
    #[error("is damaged or cut short (checksum)")]
    Checksum,
}

/// Bytes of magic and version.
const PREFIX: usize = 12;
/// Bytes of the checksum at the end.
const SEAL: usize = 4;

/// Writes magic and version, then what `body` writes, then a CRC-32 over all of it.
pub fn seal<W: Write>(kind: Kind, writer: W, body: impl FnOnce(&mut Sealing<W>) -> io::Result<()>) -> io::Result<()> {
    let mut sealing = Sealing {
        writer,
        hasher: crc32fast::Hasher::new(),
    };
    sealing.write_all(&kind.magic)?;
    sealing.write_all(&kind.version.to_le_bytes())?;
    body(&mut sealing)?;
    let Sealing { mut writer, hasher } = sealing;
    writer.write_all(&hasher.finalize().to_le_bytes())
}

/// Reads the file `seal` wrote at `path` and gives its body, which the checksum vouches for.
pub fn read_sealed(kind: Kind, path: &Path) -> Result<Vec<u8>, SealError> {
    let mut bytes = Vec::new();
    File::open(path)?.read_to_end(&mut bytes)?;
    let Some([magic @ .., a, b, c, d]) = bytes.first_chunk::<PREFIX>() else {
        return Err(SealError::Checksum);
    };
    if *magic != kind.magic {
        return Err(SealError::Kind(kind.name));
    }
    // The envelope is the same in every version, so that a damaged version is not taken for another one.
    let version = u32::from_le_bytes([*a, *b, *c, *d]);
    match bytes.split_last_chunk::<SEAL>() {
        Some((rest, seal)) if rest.len() >= PREFIX && crc32fast::hash(rest).to_le_bytes() == *seal => {}
        _ => return Err(SealError::Checksum),
    }
    if version != kind.version {
        return Err(SealError::Version {
            found: version,
            expected: kind.version,
        });
    }
    bytes.truncate(bytes.len() - SEAL);
    bytes.drain(..PREFIX);
    Ok(bytes)
}

/// The body of a sealed file while it is written.
#[derive(Debug)]
pub struct Sealing<W> {
    writer: W,
    hasher: crc32fast::Hasher,
}

impl<W: Write> Write for Sealing<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.writer.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.writer.flush()
    }
}
