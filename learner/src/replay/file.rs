//! Creates and opens the file: space, permissions, lock, and the check that it is the run's file.

use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{self, Write};
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::Duration;

use rustix::fs::{CWD, FallocateFlags, RenameFlags, fallocate, renameat_with};
use rustix::io::Errno;
use rustix::process::{Resource, getrlimit};
use shoal_common::commit::{CommitRecord, FileOffsets, ReplayLayout, SYNCED, Words, WritableWords};
use shoal_common::durable::{allocated_bytes, sync_directory_of};
use shoal_common::file_lock;

use super::error::ReplayError;

/// Creates an empty replay under a temporary name and renames it, so that a file with the replay's name is whole.
pub(super) fn create(path: &Path, layout: &ReplayLayout) -> Result<(File, FileOffsets), ReplayError> {
    let offsets = offsets(path, layout)?;
    let check = || match fs::exists(path).map_err(io(path, "look for"))? {
        true => Err(ReplayError::Exists(path.into())),
        false => Ok(()),
    };
    check()?;
    let temporary = temporary(path);
    let mut options = OpenOptions::new();
    // Truncated only under the lock, because another process may be creating it.
    let file = options
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .mode(0o600)
        .open(&temporary);
    let file = file.map_err(io(path, "create"))?;
    lock(path, &file)?;
    // Again, because another process may have published this very file while this one waited for the lock.
    check()?;
    let temporary = Temporary(temporary);
    file.set_len(0)
        .and_then(|()| file.set_permissions(Permissions::from_mode(0o600)))
        .map_err(io(path, "create"))?;
    reserve(path, &file, offsets.end as u64)?;

    let mut words = WritableWords::map(&file, offsets.header).map_err(io(path, "map"))?;
    for (i, word) in layout.preamble().into_iter().enumerate() {
        words.store(i * size_of::<u64>(), word);
    }
    let mut record = CommitRecord::empty(layout);
    record.set_generation(1);
    // As committed and as synced, so that a power loss always leaves a state to fall back to.
    for slot in [1, SYNCED] {
        record.store(&mut words, offsets.slots[slot], |_| ());
    }
    words.store(offsets.published, record.generation());
    drop(words);

    file.sync_all().map_err(io(path, "sync"))?;
    rename_to_new(&temporary.0, path)?;
    sync_directory_of(path).map_err(io(path, "sync"))?;
    Ok((file, offsets))
}

/// The name of the file at `path` while it is created.
fn temporary(path: &Path) -> PathBuf {
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".new");
    temporary.into()
}

/// Bytes of disk that a killed [`create`] has reserved for the file at `path`. The next `create` frees them first.
pub(crate) fn unfinished_bytes(path: &Path) -> u64 {
    allocated_bytes(&temporary(path))
}

/// Opens the file and compares it with the layout before anything is mapped for writing.
pub(super) fn open(path: &Path, layout: &ReplayLayout) -> Result<(File, FileOffsets), ReplayError> {
    let refused = |reason| ReplayError::Refused {
        path: path.into(),
        reason,
    };
    let offsets = offsets(path, layout)?;
    let file = match OpenOptions::new().read(true).write(true).open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Err(ReplayError::Missing(path.into())),
        file => file.map_err(io(path, "open"))?,
    };
    lock(path, &file)?;
    let length = file.metadata().map_err(io(path, "open"))?.len();
    if length < offsets.header as u64 {
        return Err(refused(format!(
            "it is cut short: {length} bytes, and a replay for this run has {}",
            offsets.end
        )));
    }
    let words = Words::map(&file, offsets.header).map_err(io(path, "map"))?;
    let found = ReplayLayout::read(&words).map_err(|fault| refused(fault.to_string()))?;
    if let Some(difference) = layout.difference(&found) {
        return Err(refused(difference));
    }
    if length != offsets.end as u64 {
        return Err(refused(format!(
            "it has {length} bytes, and by its header it should have {}",
            offsets.end
        )));
    }
    Ok((file, offsets))
}

fn offsets(path: &Path, layout: &ReplayLayout) -> Result<FileOffsets, ReplayError> {
    layout.offsets().ok_or_else(|| ReplayError::Impossible {
        path: path.into(),
        ring: layout.ring,
        actors: layout.actors,
    })
}

/// Locks the file. The kernel releases the lock with the file's last descriptor and mapping, so also when the process
/// is killed.
fn lock(path: &Path, file: &File) -> Result<(), ReplayError> {
    // A process that was just killed, or a forked child before its `exec`, may still hold it.
    match file_lock::lock(file, Duration::from_secs(1)).map_err(io(path, "lock"))? {
        true => Ok(()),
        false => Err(ReplayError::InUse(path.into())),
    }
}

/// Reserves the space, so that a full disk is an error here and not a SIGBUS at some later row.
fn reserve(path: &Path, file: &File, bytes: u64) -> Result<(), ReplayError> {
    let no_space = |source: Errno| ReplayError::NoSpace {
        path: path.into(),
        bytes,
        source: source.into(),
    };
    // Checked first: beyond the limit the kernel sends SIGXFSZ, which by default ends the process.
    if getrlimit(Resource::Fsize).current.is_some_and(|limit| limit < bytes) {
        return Err(no_space(Errno::FBIG));
    }
    loop {
        match fallocate(file, FallocateFlags::empty(), 0, bytes) {
            Ok(()) => return Ok(()),
            Err(Errno::INTR) => {}
            Err(error @ (Errno::NOSPC | Errno::DQUOT | Errno::FBIG)) => return Err(no_space(error)),
            Err(Errno::OPNOTSUPP | Errno::NOSYS) => return fill(path, file, bytes),
            Err(error) => return Err(io(path, "reserve space for")(error.into())),
        }
    }
}

/// Reserves the space by writing zeros, for file systems without `fallocate`.
fn fill(path: &Path, mut file: &File, bytes: u64) -> Result<(), ReplayError> {
    static ZEROS: [u8; 1 << 16] = [0; 1 << 16];
    let mut left = bytes;
    while left > 0 {
        let part = left.min(ZEROS.len() as u64);
        file.write_all(&ZEROS[..part as usize])
            .map_err(|source| ReplayError::NoSpace {
                path: path.into(),
                bytes,
                source,
            })?;
        left -= part;
    }
    Ok(())
}

/// Renames without replacing.
fn rename_to_new(temporary: &Path, path: &Path) -> Result<(), ReplayError> {
    match renameat_with(CWD, temporary, CWD, path, RenameFlags::NOREPLACE) {
        Ok(()) => Ok(()),
        Err(Errno::EXIST) => Err(ReplayError::Exists(path.into())),
        // A file system without the flag: `create` has checked the name, and the lock on the temporary file keeps other
        // learners out.
        Err(Errno::INVAL | Errno::NOSYS) => fs::rename(temporary, path).map_err(io(path, "create")),
        Err(error) => Err(io(path, "create")(error.into())),
    }
}

/// Removes the temporary name on the way out; after a successful rename there is nothing left to remove.
struct Temporary(PathBuf);

impl Drop for Temporary {
    fn drop(&mut self) {
        let _ = fs::remove_file(&self.0);
    }
}

fn io(path: &Path, action: &'static str) -> impl Fn(io::Error) -> ReplayError {
    let path = path.to_path_buf();
    move |source| ReplayError::Io {
        path: path.clone(),
        action,
        source,
    }
}
