//! Files that are either complete or absent: they are written under a temporary name, synced and renamed. A sealed file
//! also has an envelope with a checksum, which reveals later damage.

use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, BufWriter, Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};

/// A file that is complete and on the disk, still under its temporary name. Dropping it without publishing removes it.
#[derive(Debug)]
#[must_use = "the file appears only when it is published"]
pub struct PreparedFile {
    temporary: PathBuf,
    path: PathBuf,
    published: bool,
    /// Locked, so that no other process writes the temporary file before it has its final name.
    file: File,
}

impl PreparedFile {
    /// Writes and syncs a file for `path`, readable by the owner alone. The temporary name is `path` with `.new`
    /// appended; a file that a killed process left there is overwritten. If another process is writing that
    /// file, this one gets a unique name.
    pub fn write<E: From<io::Error>>(
        path: &Path,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
    ) -> Result<Self, E> {
        let prepared = Self::unsynced(path, write)?;
        prepared.file.sync_all()?;
        Ok(prepared)
    }

    fn unsynced<E: From<io::Error>>(
        path: &Path,
        write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
    ) -> Result<Self, E> {
        let (temporary, file) = open_temporary(path)?;
        let prepared = Self {
            temporary,
            path: path.into(),
            published: false,
            file: file.try_clone()?,
        };
        file.set_permissions(Permissions::from_mode(0o600))?;
        let mut writer = BufWriter::with_capacity(1 << 16, file);
        write(&mut writer)?;
        writer.flush()?;
        Ok(prepared)
    }

    /// Renames the file to its final name, which atomically replaces a file of that name.
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

impl Drop for PreparedFile {
    fn drop(&mut self) {
        if !self.published {
            // A failure does no harm: the next write uses the same temporary name.
            let _ = fs::remove_file(&self.temporary);
        }
    }
}

/// Opens an empty temporary file for `path`. As long as it is open, no other process writes it.
fn open_temporary(path: &Path) -> io::Result<(PathBuf, File)> {
    let named = |ending: &str| {
        let mut name = path.as_os_str().to_owned();
        name.push(ending);
        PathBuf::from(name)
    };
    let open = |temporary: &Path| {
        let mut options = OpenOptions::new();
        // Truncated only under the lock.
        options
            .write(true)
            .create(true)
            .truncate(false)
            .mode(0o600)
            .open(temporary)
    };
    let temporary = named(".new");
    let file = open(&temporary)?;
    let is_there = |file: &File| -> io::Result<bool> {
        let (opened, there) = (file.metadata()?, fs::metadata(&temporary));
        Ok(there.is_ok_and(|there| (there.dev(), there.ino()) == (opened.dev(), opened.ino())))
    };
    // If it is not there any more, another process has renamed it.
    if file.try_lock().is_ok() && is_there(&file)? {
        file.set_len(0)?;
        return Ok((temporary, file));
    }
    static OWN: AtomicU32 = AtomicU32::new(0);
    let number = OWN.fetch_add(1, Ordering::Relaxed);
    let temporary = named(&format!(".{}-{number}.new", std::process::id()));
    let file = open(&temporary)?;
    file.set_len(0)?;
    Ok((temporary, file))
}

/// Bytes of disk that the file at `path` occupies; 0 if there is none.
pub fn allocated_bytes(path: &Path) -> u64 {
    /// The unit of `blocks()` in bytes, whatever the file system's block size.
    const BLOCK: u64 = 512;
    fs::metadata(path).map_or(0, |file| file.blocks() * BLOCK)
}

/// Writes a file atomically: at any moment `path` is either the old file or the complete new one, even after a power
/// loss.
pub fn write_atomically<E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), E> {
    Ok(PreparedFile::write(path, write)?.publish()?)
}

/// Like [`write_atomically`], but without waiting for the disk: the file is whole after any process dies, but a power
/// loss may damage it.
pub fn write_atomically_unsynced<E: From<io::Error>>(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<File>) -> Result<(), E>,
) -> Result<(), E> {
    let mut prepared = PreparedFile::unsynced(path, write)?;
    Ok(prepared.rename()?)
}

/// Syncs the directory of `path`, so that the names in it survive a power loss.
pub fn sync_directory_of(path: &Path) -> io::Result<()> {
    let directory = path
        .parent()
        .filter(|parent| !parent.as_os_str().is_empty())
        .unwrap_or(Path::new("."));
    File::open(directory)?.sync_all()
}

/// A kind of sealed file: the prefix of such files, and the kind's name.
#[derive(Clone, Copy, Debug)]
pub struct FileKind {
    /// Identifies the kind of file.
    pub magic: [u8; 8],
    /// The number of its format; increase it with every change.
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
    #[error("has format {found}; this program reads format {expected}")]
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
pub fn seal<W: Write>(
    kind: FileKind,
    writer: W,
    body: impl FnOnce(&mut ChecksumWriter<W>) -> io::Result<()>,
) -> io::Result<()> {
    let mut sealing = ChecksumWriter {
        writer,
        hasher: crc32fast::Hasher::new(),
    };
    sealing.write_all(&kind.magic)?;
    sealing.write_all(&kind.version.to_le_bytes())?;
    body(&mut sealing)?;
    let ChecksumWriter { mut writer, hasher } = sealing;
    writer.write_all(&hasher.finalize().to_le_bytes())
}

/// Reads a file that [`seal`] wrote at `path`, checks its checksum and returns its body.
pub fn read_sealed(kind: FileKind, path: &Path) -> Result<Vec<u8>, SealError> {
    let mut bytes = Vec::new();
    File::open(path)?.read_to_end(&mut bytes)?;
    unseal(kind, bytes)
}

/// Checks the checksum of what [`seal`] wrote and returns its body.
pub fn unseal(kind: FileKind, mut bytes: Vec<u8>) -> Result<Vec<u8>, SealError> {
    let Some([magic @ .., a, b, c, d]) = bytes.first_chunk::<PREFIX>() else {
        return Err(SealError::Checksum);
    };
    if *magic != kind.magic {
        // A power loss may leave zeros where the file was not on the disk yet.
        if *magic == [0; 8] {
            return Err(SealError::Checksum);
        }
        return Err(SealError::Kind(kind.name));
    }
    // The checksum comes before the version: the envelope is the same in every version, so a damaged version number is
    // reported as damage.
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

/// The writer for the body of a sealed file.
#[derive(Debug)]
pub struct ChecksumWriter<W> {
    writer: W,
    hasher: crc32fast::Hasher,
}

impl<W: Write> Write for ChecksumWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let written = self.writer.write(bytes)?;
        self.hasher.update(&bytes[..written]);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.writer.flush()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_writers_of_a_file_do_not_mix_their_bytes() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("file");
        let prepare = |text: &'static str| PreparedFile::write(&path, |file| file.write_all(text.as_bytes())).unwrap();
        // A killed writer has left this.
        fs::write(
            directory.path().join("file.new"),
            "a long text that was never published",
        )
        .unwrap();
        let first = prepare("first");
        let second = prepare("second");
        first.publish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "first");
        drop(prepare("third"));
        second.publish().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "second");
        assert_eq!(
            fs::read_dir(directory.path()).unwrap().count(),
            1,
            "no temporary file is left"
        );
    }
}
